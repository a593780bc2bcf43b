"""Former names of keys, wire fields and FITS extensions: files and logs of released versions stay readable."""

from typing import Any

KEYS = {
    "control.late_ms": "control.max_frame_age_ms",
    "control.hold_ms": "control.frame_timeout_ms",
    "control.valid_ms": "control.command_timeout_ms",
    "control.silence": "control.on_frame_timeout",
    "control.most_alike": "control.max_identical_frames",
    "control.most_saturated": "control.max_saturated_pixels",
    "control.least_flux": "control.min_flux_fraction",
    "mirror.expired": "mirror.on_command_timeout",
    "realtime.stay_awake": "realtime.disable_cpu_idle",
    "realtime.rehearse": "realtime.cache_warmup",
}
"""Current names of configuration keys, by their names in version 0.1 and before."""

FIELDS = {
    **{
        f"{message}.taken": "input_number"
        for message in ("ControlStep", "ControlInput", "ControllerState", "Request", "MirrorCommand")
    },
    "LinearLaw.follow": "transition",
    "LinearLaw.gain": "measurement_gain",
    "LinearLaw.kept": "command_gain",
    "LinearLaw.coast": "predict_only",
    "ControllerState.silent": "frame_timeout",
    "ControllerState.homing": "returning_to_zero",
    "ControllerState.alike": "identical_frames",
    "ControllerSettings.late_ns": "max_frame_age_ns",
    "ControllerSettings.hold_ns": "frame_timeout_ns",
    "ControllerSettings.silence": "on_frame_timeout",
    "ControllerSettings.least_flux": "min_flux_fraction",
    "ControllerSettings.most_saturated": "max_saturated_pixels",
    "ControllerSettings.most_alike": "max_identical_frames",
    "Health.heard": "peers_alive",
    "Health.granted": "realtime_granted",
    "Health.refused": "realtime_refused",
}
"""Current names of message fields, by their names in version 0.1 and before; numbers, types and labels never change."""

VALUES = {"LOOP_MODE_SAFED": "LOOP_MODE_SAFE"}
"""Current names of enumeration values, by their names in version 0.1 and before."""

LAW_EXTENSIONS = {
    "TRANSITION": "FOLLOW",
    "MEASUREMENT_GAIN": "GAIN",
    "COMMAND_GAIN": "KEPT",
    "PREDICT_ONLY": "COAST",
    "OUTPUT": "OUTPUT",
}
"""Extensions of a law file of kind "lowfc law 1", by their current names."""


def renamed_keys(data: dict[str, Any]) -> list[str]:
    """Rename the former keys of a configuration's tables in place; return a remark for each.

    ValueError if a key is present under both names.
    """
    remarks = []
    for former, name in KEYS.items():
        section, _, key = former.partition(".")
        new = name.partition(".")[2]
        table = data.get(section)
        if isinstance(table, dict) and key in table:
            if new in table:
                raise ValueError(f"{former} is the former name of {name}, and both are present: remove {former}")
            table[new] = table.pop(key)
            remarks.append(f"{former} is now called {name}")
    return remarks
