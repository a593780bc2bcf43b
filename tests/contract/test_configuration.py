"""The configuration: valid defaults, and one clear line for each error."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from pydantic import Field, create_model

from lowfc.adapters.bus.names import MAX_NAMES
from lowfc.contract.configuration import Configuration, keys, load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.network import Section
from lowfc.contract.sections import IMPERFECTIONS, InterlockSection
from lowfc.device import DriverOptions
from lowfc.device.mirror_loop import protection_of
from lowfc.programs.cli.config import commented
from sim_dm.driver import SimulatedMirror
from tools.world import CASES

KEYS = keys()


def write(folder: Path, text: str) -> Path:
    path = folder / "lowfc.toml"
    path.write_text(text, encoding="utf-8")
    return path


def error_of(path: Path | None, overrides: dict[str, Any] | None = None) -> str:
    with pytest.raises(ConfigurationError) as caught:
        load(path, overrides)
    return str(caught.value)


def test_the_limits_of_the_mirror_are_by_default_wider_than_those_of_the_controller() -> None:
    config = load(None)
    assert config == Configuration()
    protection = protection_of(SimulatedMirror(DriverOptions(), config), config)
    for name in ("stroke_nm", "slew_nm", "neighbour_nm"):
        assert getattr(protection.tightened_limits, name) > getattr(config.safety, name), name


def test_every_key_has_a_description() -> None:
    sections = {type(value) for _, value in Configuration() if isinstance(value, Section)}
    for section in (Configuration, InterlockSection, *sections):
        descriptions = section.descriptions()
        assert descriptions.keys() == section.model_fields.keys()
        subsections = {key for key, info in section.model_fields.items() if isinstance(info.default, Section)}
        assert [key for key, text in descriptions.items() if not text.endswith(".") and key not in subsections] == []


class Outer:
    class Options(InterlockSection):
        first: int = 1
        """One line,
and one at the margin."""
        second: int = Field(2, description="Declared.")


def test_keys_of_a_nested_class_have_descriptions_and_own_keys_of_a_class_without_source_have_none() -> None:
    inherited = InterlockSection.descriptions()
    own = {"first": "One line,\nand one at the margin.", "second": "Declared."}
    assert Outer.Options.descriptions() == inherited | own
    without_source = create_model("Made", __base__=InterlockSection, third=(int, 3))
    assert without_source.descriptions() == inherited | {"third": ""}


def test_a_configuration_round_trips_through_toml(tmp_path: Path) -> None:
    config = load(None, {"seed": 7, "mirror.stuck_nm": {"3": 25.0}, "mirror.dead": [1, 2], "camera.delay_frames": 1.5})
    assert load(write(tmp_path, config.to_toml())) == config
    long_line = load(None, {"mirror.stuck_nm": {str(actuator): 0.5 for actuator in range(150)}})
    assert load(write(tmp_path, commented(long_line))) == long_line, "a line of 150 floats is read back too"
    options = {"tables": [{"a b": 1.5}, {"c": [[1, 2], []]}], "text": 'quoted "\n', "none": {}}
    unusual = load(None, {"drivers": {"own": options}, "recorder.on_event": "a\N{LINE SEPARATOR}b"})
    assert load(write(tmp_path, commented(unusual))) == load(write(tmp_path, unusual.to_toml())) == unusual
    assert tomllib.loads(config.to_toml()) == config.model_dump(), "every key is written"


@pytest.mark.parametrize(
    ("text", "unknown", "nearest"),
    [
        ("[camera]\nrate_hertz = 500", "camera.rate_hertz", "camera.rate_hz"),
        ("[control]\ntiltgain = 0.5", "control.tiltgain", "control.tilt_gain"),
        ("[contol]\ngain = 0.5", "contol", "control"),
        ("lock_step = true", "lock_step", "lockstep"),
        ("gian = 0.5", "gian", "control.gain"),
        ("[control]\nrate_hz = 500", "control.rate_hz", "camera.rate_hz"),
        ("[mirror]\nzzz = 1", "mirror.zzz", "mirror"),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_known_one(
    tmp_path: Path, text: str, unknown: str, nearest: str
) -> None:
    path = write(tmp_path, text)
    message = error_of(path)
    assert message.startswith(f"{path}: unknown key {unknown!r}; the nearest known one is '{nearest}'")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("camera.rate_hz", 0),
        ("camera.rate_hz", float("nan")),
        ("camera.rate_hz", 1e-15),
        ("control.max_frame_age_ms", 1e10),
        ("control.max_start_ahead_h", 1e306),
        ("recorder.on_event_every_s", 1e10),
        *((f"camera.{key}", 1e13) for key in ("read_noise_e", "hot_pixel_e_s", "full_well_e", "gain_e_per_dn")),
        *((f"control.max_{key}", 2**32) for key in ("saturated_pixels", "identical_frames")),
        *((f"acceptance.{key}", 1e13) for key in ("rejection_db", "noise_ratio")),
        *((f"disturbance.{key}", -1e13) for key in ("second_wheel_hz", "static_nm.4", "drift_nm.4", "wheel_change")),
        *((f"disturbance.{key}", 1e13) for key in ("scale", "jitter_mas", "wheel_hz", "wheel_mas")),
        *((f"acceptance.{key}", 1e6) for key in ("linear_nm", "capture_nm", "capture_tilt_nm")),
        ("acceptance.linear_nm", 1e-8),
        ("mirror.nm_per_unit", 1e-46),
        *((f"mirror.{key}", 1e13) for key in ("stroke_nm", "settling_us", "stuck_nm.3")),
        ("control.frame_timeout_ms", 1e10),
        ("control.command_timeout_ms", 1e10),
        ("realtime.camera_cpus", [10**20]),
        ("realtime.controller_cpus", [-1]),
        ("camera.rate_hz", "250"),
        ("camera.bit_depth", 17),
        ("camera.bit_depth", 14.0),
        ("camera.noise", 1),
        ("seed", True),
        ("control.leak", 1.1),
        ("control.start_mode", "safed"),
        ("disturbance.preset", "earthquake"),
        ("mirror.name", "DM 1"),
        ("mirror.dead", ["x"]),
        ("mirror.flat", 7),
        ("safety.slew_nm", 0),
        ("safety.slew_nm", 1e308),
        *((key, "a\0b") for key in ("gateway.search", "network.certificates", "recorder.folder", "recorder.on_event")),
        ("network.router", "tls/a\0b:7447"),
        ("gateway.listen", ""),  # the library would listen on all addresses
        ("gateway.bench.mask", ""),
    ],
)
def test_an_invalid_value_is_reported_in_one_line_with_key_and_value(key: str, value: object) -> None:
    message = error_of(None, {key: value})
    assert message.startswith(key)
    assert f" = {repr(value).strip('[]')}: " in message  # for a list, its only item
    assert "\n" not in message


def test_a_gateway_has_no_more_bench_values_than_a_recorder_records() -> None:
    variables = {f"value-{number}": "PV" for number in range(MAX_NAMES + 1)}
    assert "at most 64 items" in error_of(None, {"gateway.bench": variables})
    del variables["value-0"]
    assert load(None, {"gateway.bench": variables}).gateway.bench == variables


def test_each_error_line_of_a_key_that_accepts_several_types_names_the_key() -> None:
    lines = error_of(None, {"interlocks": [{"name": "mask", "action": "hold", "value": [1]}]}).splitlines()
    assert len(lines) == 3
    assert {line.partition(" = ")[0] for line in lines} == {"interlocks.0.value"}


@pytest.mark.parametrize("key", ["router", "listen"])
@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tls/bench:99999", "the highest port is 65535, got 99999"),
        ("tls/a..b:7447", "'a..b' is not the name or address"),
        *(
            (address, "match pattern")
            for address in ("tcp/bench:7447", "tls/bench", "tls/bench:0", "bench:7447", "tls/:7447x")
        ),
    ],
)
def test_an_invalid_address_of_the_router_is_refused(key: str, address: str, message: str) -> None:
    keys = {"network.router": "tls/[::1]:7447", "network.certificates": "certs"}
    assert load(None, keys).network.address == ("::1", 7447)
    error = error_of(None, {**keys, f"network.{key}": address})
    assert key in error
    assert message in error
    assert "certificates: a folder is needed" in error_of(None, {**keys, "network.certificates": ""})


def test_config_show_sets_only_keys_that_were_set(tmp_path: Path) -> None:
    """A file with the output of `config show` leaves a command's own defaults in force."""
    defaults_file = write(tmp_path, commented(load(None)))
    assert all(section == {} for section in tomllib.loads(defaults_file.read_text()).values())
    assert load(defaults_file, None, {"control.start_mode": "closed"}).control.start_mode == "closed"
    assert {line.removeprefix("#").split(" = ")[0] for line in defaults_file.read_text().splitlines()} >= {
        key.rpartition(".")[2] for key in KEYS
    }
    chosen = {
        "control": {"start_mode": "open"},  # equal to the default, but set
        "disturbance": {"static_nm": {"4": 1.5}},
        "mirror": {"dead": [1, 2], "stuck_nm": {"3": 25.0, "5": -2.0}},
    }
    config = load(write(tmp_path, tomli_w.dumps(chosen)))
    shown = write(tmp_path, commented(config))
    assert {name: keys for name, keys in tomllib.loads(shown.read_text()).items() if keys} == chosen
    assert load(shown, None, {"control.start_mode": "closed"}) == config
    uncommented = "\n".join(re.sub(r"^#(?! )", "", line) for line in commented(load(None)).splitlines())
    assert load(write(tmp_path, uncommented)) == Configuration(), "each key can be uncommented unchanged"


def test_a_quoted_key_with_dots_is_not_suggested_as_its_own_correction(tmp_path: Path) -> None:
    message = error_of(write(tmp_path, '"camera.rate_hz" = 100'))
    assert message.endswith("unknown key 'camera.rate_hz'; write it without quotes, which make it one name")


def test_each_error_has_its_own_line_and_names_file_and_key_as_written(tmp_path: Path) -> None:
    path = write(tmp_path, "[camera]\nrate_hz = 'x'\n[control]\ngain = [1.0]")
    assert error_of(path).splitlines() == [
        f"{path}: camera.rate_hz = 'x': must be a valid number",
        f"{path}: control.gain = [1.0]: must be a valid number",
        f"{path}: control.gain = [1.0]: must be 'auto'",
    ]


@pytest.mark.parametrize(
    ("overrides", "phrases"),
    [
        ({"safety.stroke_nm": 800.0}, ("safety.stroke_nm", "800", "750")),
        ({"mirror.dead": [34 * 34]}, ("1156", "1155")),
        ({"mirror.dead": [-1]}, ("-1", "1155")),
        ({"mirror.stuck_nm": {"2000": 1.0}}, ("2000", "1155")),
        ({"mirror.driver_bits": 8, "mirror.slew_nm": 3.0}, ("mirror.slew_nm", "8 bits", "5.859")),
        ({"mirror.stroke_nm": 1e9, "mirror.driver_bits": 24}, ("mirror.slew_nm", "above 1024 nm")),
        ({"mirror.stroke_nm": 2e6, "mirror.slew_nm": 31.0}, ("mirror.slew_nm", "16 bits", "30.5")),
        ({"disturbance.static_nm": {"focus": 3.0}}, ("focus", "Noll")),
        ({"disturbance.static_nm": {"1": 3.0}}, ("'1'", "Noll")),
        ({"disturbance.static_nm": {"16": 3.0}}, ("disturbance", "Z16", "Z15")),
        ({"disturbance.drift_nm": {"4": 3.0}, "sensor.modes": 2}, ("disturbance", "Z4", "Z3")),
    ],
)
def test_contradicting_values_are_refused(overrides: dict[str, Any], phrases: tuple[str, ...]) -> None:
    message = error_of(None, overrides)
    assert all(phrase in message for phrase in phrases), message
    assert "\n" not in message


def test_imperfections_are_off_by_default_and_each_has_a_case_in_the_measurements() -> None:
    assert load(None).imperfections == {}
    assert {key for keys in CASES.values() for key in load(None, keys).imperfections} == set(IMPERFECTIONS)


def test_an_integer_is_accepted_for_a_float() -> None:
    config = load(None, {"camera.rate_hz": 500, "mirror.stuck_nm": {"3": 25}})
    assert (config.camera.rate_hz, config.mirror.stuck_nm["3"]) == (500.0, 25.0)
    assert isinstance(config.camera.rate_hz, float)


def test_the_error_of_a_missing_or_invalid_file_names_it(tmp_path: Path) -> None:
    assert error_of(tmp_path / "none.toml") == f"{tmp_path / 'none.toml'}: there is no such configuration file"
    assert "not a readable TOML file" in error_of(write(tmp_path, "seed = = 3"))
    (tmp_path / "latin.toml").write_bytes(b"seed = 3 # caf\xe9")
    assert "not a readable TOML file" in error_of(tmp_path / "latin.toml")
    assert "not a readable TOML file" in error_of(tmp_path)


def test_the_byte_order_mark_of_an_editor_is_ignored(tmp_path: Path) -> None:
    assert load(write(tmp_path, "\ufeffseed = 3")).seed == 3


def test_overrides_replace_values_of_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, "seed = 3\n[camera]\nrate_hz = 500")
    config = load(path, {"camera.rate_hz": 250.0})
    assert (config.seed, config.camera.rate_hz) == (3, 250.0)
    assert "must be a section" in error_of(path, {"seed.deep": 1})


def test_period_and_exposure_follow_from_the_frame_rate() -> None:
    config = load(None, {"camera.rate_hz": 800.0, "camera.exposure_fraction": 0.4, "sensor.modes": 3})
    assert (config.period_ns, config.exposure_ns, config.noll) == (1_250_000, 500_000, (2, 3, 4))
