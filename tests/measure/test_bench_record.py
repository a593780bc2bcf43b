"""What recording costs is measured on a real recorder, and said in one JSON object."""

import json

import pytest
import typer
from typer.testing import CliRunner

from lowfc.programs.measure.bench import record as bench_module
from lowfc.programs.measure.bench.record import bench_record, render

pytestmark = pytest.mark.exclusive

RATES_HZ = (100, 200)


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    folder = tmp_path_factory.mktemp("disk")
    app = typer.Typer()
    app.command()(bench_record)
    rates = [word for rate in RATES_HZ for word in ("--rate", str(rate))]
    done = CliRunner().invoke(app, ["--seconds", "0.5", *rates, "--folder", str(folder), "--json"])
    assert done.exit_code == 0, done.output
    assert list(folder.iterdir()) == []
    return json.loads(done.stdout)


def test_everything_that_was_sent_is_in_the_account(figures: dict[str, object]) -> None:
    assert [rate["rate_hz"] for rate in figures["rates"]] == list(RATES_HZ)
    for rate in figures["rates"]:
        frames = rate["rate_hz"] * (bench_module._WARM_UP_S + 0.5)
        assert rate["messages_lost"] == 0
        assert rate["messages_published"] >= 5 * frames
        assert rate["messages_recorded"] >= 5 * frames
        assert rate["log_bytes"] > 0.5 * frames * figures["payload_bytes_per_frame"]
        assert rate["cpu_share"] > 0
        assert rate["ratio"] == pytest.approx(
            rate["cpu_share"] / (figures["copy_us_per_frame"] * rate["offered_hz"] / 1e6)
        )
        assert rate["longest_unflushed_ms"] >= rate["longest_wait_ms"] > 0
        assert rate["longest_write_ms"] > 0
    assert figures["payload_bytes_per_frame"] > 80 * 80 * 2 + 2 * 34 * 34 * 4


def test_a_person_reads_one_line_for_each_rate(figures: dict[str, object]) -> None:
    title, *lines, note = render(figures).splitlines()
    assert "processor" in title
    assert "kill -9" in note
    assert [line.split()[1] for line in lines] == ["Hz"] * len(RATES_HZ)
