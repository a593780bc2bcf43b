import datetime

from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class LoopMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LOOP_MODE_UNSPECIFIED: _ClassVar[LoopMode]
    LOOP_MODE_IDLE: _ClassVar[LoopMode]
    LOOP_MODE_OPEN: _ClassVar[LoopMode]
    LOOP_MODE_CLOSED: _ClassVar[LoopMode]
    LOOP_MODE_SAFE: _ClassVar[LoopMode]

class Reason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REASON_UNSPECIFIED: _ClassVar[Reason]
    REASON_NO_CALIBRATION: _ClassVar[Reason]
    REASON_WRONG_SIZE: _ClassVar[Reason]
    REASON_OUT_OF_ORDER: _ClassVar[Reason]
    REASON_REPEATED: _ClassVar[Reason]
    REASON_LATE: _ClassVar[Reason]
    REASON_SATURATED: _ClassVar[Reason]
    REASON_DARK: _ClassVar[Reason]
    REASON_NO_FRAME: _ClassVar[Reason]
    REASON_STUCK: _ClassVar[Reason]
    REASON_AHEAD: _ClassVar[Reason]
    REASON_CAMERA_UNKNOWN: _ClassVar[Reason]
    REASON_NO_MIRROR: _ClassVar[Reason]
    REASON_HELD: _ClassVar[Reason]
    REASON_MODAL_LIMIT: _ClassVar[Reason]
    REASON_STROKE: _ClassVar[Reason]
    REASON_SLEW: _ClassVar[Reason]
    REASON_NEIGHBOUR: _ClassVar[Reason]
    REASON_NOT_FINITE: _ClassVar[Reason]
    REASON_WRONG_GRID: _ClassVar[Reason]
    REASON_CHANNEL: _ClassVar[Reason]
    REASON_LAW_OVERRULED: _ClassVar[Reason]

class MirrorStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MIRROR_STATUS_UNSPECIFIED: _ClassVar[MirrorStatus]
    MIRROR_STATUS_WAITING: _ClassVar[MirrorStatus]
    MIRROR_STATUS_FOLLOWING: _ClassVar[MirrorStatus]
    MIRROR_STATUS_EXPIRED: _ClassVar[MirrorStatus]
LOOP_MODE_UNSPECIFIED: LoopMode
LOOP_MODE_IDLE: LoopMode
LOOP_MODE_OPEN: LoopMode
LOOP_MODE_CLOSED: LoopMode
LOOP_MODE_SAFE: LoopMode
REASON_UNSPECIFIED: Reason
REASON_NO_CALIBRATION: Reason
REASON_WRONG_SIZE: Reason
REASON_OUT_OF_ORDER: Reason
REASON_REPEATED: Reason
REASON_LATE: Reason
REASON_SATURATED: Reason
REASON_DARK: Reason
REASON_NO_FRAME: Reason
REASON_STUCK: Reason
REASON_AHEAD: Reason
REASON_CAMERA_UNKNOWN: Reason
REASON_NO_MIRROR: Reason
REASON_HELD: Reason
REASON_MODAL_LIMIT: Reason
REASON_STROKE: Reason
REASON_SLEW: Reason
REASON_NEIGHBOUR: Reason
REASON_NOT_FINITE: Reason
REASON_WRONG_GRID: Reason
REASON_CHANNEL: Reason
REASON_LAW_OVERRULED: Reason
MIRROR_STATUS_UNSPECIFIED: MirrorStatus
MIRROR_STATUS_WAITING: MirrorStatus
MIRROR_STATUS_FOLLOWING: MirrorStatus
MIRROR_STATUS_EXPIRED: MirrorStatus

class CameraState(_message.Message):
    __slots__ = ("timestamp", "exposure_ns", "period_ns", "gain_e_per_dn", "bias_dn", "read_noise_e", "saturation_dn", "region_row", "region_column", "rows", "columns", "bit_depth", "em_gain", "start_s")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_NS_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    GAIN_E_PER_DN_FIELD_NUMBER: _ClassVar[int]
    BIAS_DN_FIELD_NUMBER: _ClassVar[int]
    READ_NOISE_E_FIELD_NUMBER: _ClassVar[int]
    SATURATION_DN_FIELD_NUMBER: _ClassVar[int]
    REGION_ROW_FIELD_NUMBER: _ClassVar[int]
    REGION_COLUMN_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    BIT_DEPTH_FIELD_NUMBER: _ClassVar[int]
    EM_GAIN_FIELD_NUMBER: _ClassVar[int]
    START_S_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    exposure_ns: int
    period_ns: int
    gain_e_per_dn: float
    bias_dn: float
    read_noise_e: float
    saturation_dn: float
    region_row: int
    region_column: int
    rows: int
    columns: int
    bit_depth: int
    em_gain: float
    start_s: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., exposure_ns: _Optional[int] = ..., period_ns: _Optional[int] = ..., gain_e_per_dn: _Optional[float] = ..., bias_dn: _Optional[float] = ..., read_noise_e: _Optional[float] = ..., saturation_dn: _Optional[float] = ..., region_row: _Optional[int] = ..., region_column: _Optional[int] = ..., rows: _Optional[int] = ..., columns: _Optional[int] = ..., bit_depth: _Optional[int] = ..., em_gain: _Optional[float] = ..., start_s: _Optional[int] = ...) -> None: ...

class ControlStep(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "mode", "error_nm", "pol_nm", "command_nm", "reasons", "flux_dn", "saturated_pixels", "input_number")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    ERROR_NM_FIELD_NUMBER: _ClassVar[int]
    POL_NM_FIELD_NUMBER: _ClassVar[int]
    COMMAND_NM_FIELD_NUMBER: _ClassVar[int]
    REASONS_FIELD_NUMBER: _ClassVar[int]
    FLUX_DN_FIELD_NUMBER: _ClassVar[int]
    SATURATED_PIXELS_FIELD_NUMBER: _ClassVar[int]
    INPUT_NUMBER_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: int
    mode: LoopMode
    error_nm: _containers.RepeatedScalarFieldContainer[float]
    pol_nm: _containers.RepeatedScalarFieldContainer[float]
    command_nm: _containers.RepeatedScalarFieldContainer[float]
    reasons: _containers.RepeatedScalarFieldContainer[Reason]
    flux_dn: float
    saturated_pixels: int
    input_number: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[int] = ..., mode: _Optional[_Union[LoopMode, str]] = ..., error_nm: _Optional[_Iterable[float]] = ..., pol_nm: _Optional[_Iterable[float]] = ..., command_nm: _Optional[_Iterable[float]] = ..., reasons: _Optional[_Iterable[_Union[Reason, str]]] = ..., flux_dn: _Optional[float] = ..., saturated_pixels: _Optional[int] = ..., input_number: _Optional[int] = ...) -> None: ...

class Tick(_message.Message):
    __slots__ = ("timestamp", "silent_ns")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SILENT_NS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    silent_ns: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., silent_ns: _Optional[int] = ...) -> None: ...

class Load(_message.Message):
    __slots__ = ("timestamp", "calibration_id", "source")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    calibration_id: str
    source: str
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., calibration_id: _Optional[str] = ..., source: _Optional[str] = ...) -> None: ...

class MirrorReport(_message.Message):
    __slots__ = ("timestamp", "fault", "mirror")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FAULT_FIELD_NUMBER: _ClassVar[int]
    MIRROR_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    fault: str
    mirror: MirrorState
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., fault: _Optional[str] = ..., mirror: _Optional[_Union[MirrorState, _Mapping]] = ...) -> None: ...

class BenchValue(_message.Message):
    __slots__ = ("timestamp", "number", "text", "truth")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    TRUTH_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    number: float
    text: str
    truth: bool
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., number: _Optional[float] = ..., text: _Optional[str] = ..., truth: _Optional[bool] = ...) -> None: ...

class BenchReport(_message.Message):
    __slots__ = ("timestamp", "name", "value", "age_ns")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    AGE_NS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    name: str
    value: BenchValue
    age_ns: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., name: _Optional[str] = ..., value: _Optional[_Union[BenchValue, _Mapping]] = ..., age_ns: _Optional[int] = ...) -> None: ...

class Interlock(_message.Message):
    __slots__ = ("name", "test", "value", "action", "max_age_ns", "acts_when_old")
    NAME_FIELD_NUMBER: _ClassVar[int]
    TEST_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    MAX_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    ACTS_WHEN_OLD_FIELD_NUMBER: _ClassVar[int]
    name: str
    test: str
    value: BenchValue
    action: str
    max_age_ns: int
    acts_when_old: bool
    def __init__(self, name: _Optional[str] = ..., test: _Optional[str] = ..., value: _Optional[_Union[BenchValue, _Mapping]] = ..., action: _Optional[str] = ..., max_age_ns: _Optional[int] = ..., acts_when_old: _Optional[bool] = ...) -> None: ...

class ActingInterlock(_message.Message):
    __slots__ = ("number", "action", "why")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    number: int
    action: str
    why: str
    def __init__(self, number: _Optional[int] = ..., action: _Optional[str] = ..., why: _Optional[str] = ...) -> None: ...

class ControlInput(_message.Message):
    __slots__ = ("timestamp", "input_number", "load", "mirror", "camera", "tick", "mirror_report", "bench_report")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    INPUT_NUMBER_FIELD_NUMBER: _ClassVar[int]
    LOAD_FIELD_NUMBER: _ClassVar[int]
    MIRROR_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    MIRROR_REPORT_FIELD_NUMBER: _ClassVar[int]
    BENCH_REPORT_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    input_number: int
    load: Load
    mirror: MirrorState
    camera: CameraState
    tick: Tick
    mirror_report: MirrorReport
    bench_report: BenchReport
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., input_number: _Optional[int] = ..., load: _Optional[_Union[Load, _Mapping]] = ..., mirror: _Optional[_Union[MirrorState, _Mapping]] = ..., camera: _Optional[_Union[CameraState, _Mapping]] = ..., tick: _Optional[_Union[Tick, _Mapping]] = ..., mirror_report: _Optional[_Union[MirrorReport, _Mapping]] = ..., bench_report: _Optional[_Union[BenchReport, _Mapping]] = ...) -> None: ...

class ControlTiming(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "transport_ns", "wakeup_ns", "compute_ns", "publish_ns", "frame_to_command_ns")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TRANSPORT_NS_FIELD_NUMBER: _ClassVar[int]
    WAKEUP_NS_FIELD_NUMBER: _ClassVar[int]
    COMPUTE_NS_FIELD_NUMBER: _ClassVar[int]
    PUBLISH_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_TO_COMMAND_NS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: _containers.RepeatedScalarFieldContainer[int]
    transport_ns: _containers.RepeatedScalarFieldContainer[int]
    wakeup_ns: _containers.RepeatedScalarFieldContainer[int]
    compute_ns: _containers.RepeatedScalarFieldContainer[int]
    publish_ns: _containers.RepeatedScalarFieldContainer[int]
    frame_to_command_ns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[_Iterable[int]] = ..., transport_ns: _Optional[_Iterable[int]] = ..., wakeup_ns: _Optional[_Iterable[int]] = ..., compute_ns: _Optional[_Iterable[int]] = ..., publish_ns: _Optional[_Iterable[int]] = ..., frame_to_command_ns: _Optional[_Iterable[int]] = ...) -> None: ...

class ReasonCount(_message.Message):
    __slots__ = ("reason", "count")
    REASON_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    reason: Reason
    count: int
    def __init__(self, reason: _Optional[_Union[Reason, str]] = ..., count: _Optional[int] = ...) -> None: ...

class ControllerSettings(_message.Message):
    __slots__ = ("stroke_nm", "slew_nm", "neighbour_nm", "delay_frames", "start_mode", "max_frame_age_ns", "frame_timeout_ns", "on_frame_timeout", "min_flux_fraction", "max_saturated_pixels", "gain", "leak", "limit_nm", "max_identical_frames", "rate_hz", "auto_gain", "guard", "interlocks", "kernel")
    STROKE_NM_FIELD_NUMBER: _ClassVar[int]
    SLEW_NM_FIELD_NUMBER: _ClassVar[int]
    NEIGHBOUR_NM_FIELD_NUMBER: _ClassVar[int]
    DELAY_FRAMES_FIELD_NUMBER: _ClassVar[int]
    START_MODE_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAME_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_TIMEOUT_NS_FIELD_NUMBER: _ClassVar[int]
    ON_FRAME_TIMEOUT_FIELD_NUMBER: _ClassVar[int]
    MIN_FLUX_FRACTION_FIELD_NUMBER: _ClassVar[int]
    MAX_SATURATED_PIXELS_FIELD_NUMBER: _ClassVar[int]
    GAIN_FIELD_NUMBER: _ClassVar[int]
    LEAK_FIELD_NUMBER: _ClassVar[int]
    LIMIT_NM_FIELD_NUMBER: _ClassVar[int]
    MAX_IDENTICAL_FRAMES_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    AUTO_GAIN_FIELD_NUMBER: _ClassVar[int]
    GUARD_FIELD_NUMBER: _ClassVar[int]
    INTERLOCKS_FIELD_NUMBER: _ClassVar[int]
    KERNEL_FIELD_NUMBER: _ClassVar[int]
    stroke_nm: float
    slew_nm: float
    neighbour_nm: float
    delay_frames: float
    start_mode: LoopMode
    max_frame_age_ns: int
    frame_timeout_ns: int
    on_frame_timeout: str
    min_flux_fraction: float
    max_saturated_pixels: int
    gain: _containers.RepeatedScalarFieldContainer[float]
    leak: _containers.RepeatedScalarFieldContainer[float]
    limit_nm: _containers.RepeatedScalarFieldContainer[float]
    max_identical_frames: int
    rate_hz: float
    auto_gain: _containers.RepeatedScalarFieldContainer[bool]
    guard: bool
    interlocks: _containers.RepeatedCompositeFieldContainer[Interlock]
    kernel: str
    def __init__(self, stroke_nm: _Optional[float] = ..., slew_nm: _Optional[float] = ..., neighbour_nm: _Optional[float] = ..., delay_frames: _Optional[float] = ..., start_mode: _Optional[_Union[LoopMode, str]] = ..., max_frame_age_ns: _Optional[int] = ..., frame_timeout_ns: _Optional[int] = ..., on_frame_timeout: _Optional[str] = ..., min_flux_fraction: _Optional[float] = ..., max_saturated_pixels: _Optional[int] = ..., gain: _Optional[_Iterable[float]] = ..., leak: _Optional[_Iterable[float]] = ..., limit_nm: _Optional[_Iterable[float]] = ..., max_identical_frames: _Optional[int] = ..., rate_hz: _Optional[float] = ..., auto_gain: _Optional[_Iterable[bool]] = ..., guard: _Optional[bool] = ..., interlocks: _Optional[_Iterable[_Union[Interlock, _Mapping]]] = ..., kernel: _Optional[str] = ...) -> None: ...

class Channel(_message.Message):
    __slots__ = ("name", "actuators", "shifts", "reached")
    NAME_FIELD_NUMBER: _ClassVar[int]
    ACTUATORS_FIELD_NUMBER: _ClassVar[int]
    SHIFTS_FIELD_NUMBER: _ClassVar[int]
    REACHED_FIELD_NUMBER: _ClassVar[int]
    name: str
    actuators: bytes
    shifts: bool
    reached: bytes
    def __init__(self, name: _Optional[str] = ..., actuators: _Optional[bytes] = ..., shifts: _Optional[bool] = ..., reached: _Optional[bytes] = ...) -> None: ...

class Play(_message.Message):
    __slots__ = ("target", "first_sequence", "columns", "table", "basis", "id", "frames", "timestamp")
    TARGET_FIELD_NUMBER: _ClassVar[int]
    FIRST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    TABLE_FIELD_NUMBER: _ClassVar[int]
    BASIS_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    target: str
    first_sequence: int
    columns: int
    table: bytes
    basis: bytes
    id: str
    frames: int
    timestamp: _timestamp_pb2.Timestamp
    def __init__(self, target: _Optional[str] = ..., first_sequence: _Optional[int] = ..., columns: _Optional[int] = ..., table: _Optional[bytes] = ..., basis: _Optional[bytes] = ..., id: _Optional[str] = ..., frames: _Optional[int] = ..., timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class LinearLaw(_message.Message):
    __slots__ = ("name", "signal", "noll", "delay_frames", "rate_hz", "states", "transition", "measurement_gain", "command_gain", "predict_only", "output", "id", "timestamp")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SIGNAL_FIELD_NUMBER: _ClassVar[int]
    NOLL_FIELD_NUMBER: _ClassVar[int]
    DELAY_FRAMES_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    STATES_FIELD_NUMBER: _ClassVar[int]
    TRANSITION_FIELD_NUMBER: _ClassVar[int]
    MEASUREMENT_GAIN_FIELD_NUMBER: _ClassVar[int]
    COMMAND_GAIN_FIELD_NUMBER: _ClassVar[int]
    PREDICT_ONLY_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    name: str
    signal: str
    noll: _containers.RepeatedScalarFieldContainer[int]
    delay_frames: float
    rate_hz: float
    states: int
    transition: bytes
    measurement_gain: bytes
    command_gain: bytes
    predict_only: bytes
    output: bytes
    id: str
    timestamp: _timestamp_pb2.Timestamp
    def __init__(self, name: _Optional[str] = ..., signal: _Optional[str] = ..., noll: _Optional[_Iterable[int]] = ..., delay_frames: _Optional[float] = ..., rate_hz: _Optional[float] = ..., states: _Optional[int] = ..., transition: _Optional[bytes] = ..., measurement_gain: _Optional[bytes] = ..., command_gain: _Optional[bytes] = ..., predict_only: _Optional[bytes] = ..., output: _Optional[bytes] = ..., id: _Optional[str] = ..., timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class ControllerState(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "mode", "calibration_id", "gain", "leak", "limit_nm", "delay_frames", "command_history_nm", "actuators", "offset", "counts", "frames_used", "frame_timestamp", "refused", "refused_count", "limits_hit", "frame_timeout", "commanded", "input_number", "settings", "offset_nm", "channels", "shift_history_nm", "law", "law_state", "law_frames", "play", "steps_left", "returning_to_zero", "measured_nm", "flux_dn", "identical_frames", "camera", "camera_expected", "camera_awaited", "clear_id", "mode_timestamp", "mode_cause", "lease", "mirror_rows", "mirror_columns", "mirror_fault", "calibration_provisional", "automatic", "prior_nm2", "weighting_flux_dn", "guard", "interlocks_acting")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    GAIN_FIELD_NUMBER: _ClassVar[int]
    LEAK_FIELD_NUMBER: _ClassVar[int]
    LIMIT_NM_FIELD_NUMBER: _ClassVar[int]
    DELAY_FRAMES_FIELD_NUMBER: _ClassVar[int]
    COMMAND_HISTORY_NM_FIELD_NUMBER: _ClassVar[int]
    ACTUATORS_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    COUNTS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_USED_FIELD_NUMBER: _ClassVar[int]
    FRAME_TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_COUNT_FIELD_NUMBER: _ClassVar[int]
    LIMITS_HIT_FIELD_NUMBER: _ClassVar[int]
    FRAME_TIMEOUT_FIELD_NUMBER: _ClassVar[int]
    COMMANDED_FIELD_NUMBER: _ClassVar[int]
    INPUT_NUMBER_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    OFFSET_NM_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    SHIFT_HISTORY_NM_FIELD_NUMBER: _ClassVar[int]
    LAW_FIELD_NUMBER: _ClassVar[int]
    LAW_STATE_FIELD_NUMBER: _ClassVar[int]
    LAW_FRAMES_FIELD_NUMBER: _ClassVar[int]
    PLAY_FIELD_NUMBER: _ClassVar[int]
    STEPS_LEFT_FIELD_NUMBER: _ClassVar[int]
    RETURNING_TO_ZERO_FIELD_NUMBER: _ClassVar[int]
    MEASURED_NM_FIELD_NUMBER: _ClassVar[int]
    FLUX_DN_FIELD_NUMBER: _ClassVar[int]
    IDENTICAL_FRAMES_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    CAMERA_EXPECTED_FIELD_NUMBER: _ClassVar[int]
    CAMERA_AWAITED_FIELD_NUMBER: _ClassVar[int]
    CLEAR_ID_FIELD_NUMBER: _ClassVar[int]
    MODE_TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    MODE_CAUSE_FIELD_NUMBER: _ClassVar[int]
    LEASE_FIELD_NUMBER: _ClassVar[int]
    MIRROR_ROWS_FIELD_NUMBER: _ClassVar[int]
    MIRROR_COLUMNS_FIELD_NUMBER: _ClassVar[int]
    MIRROR_FAULT_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_PROVISIONAL_FIELD_NUMBER: _ClassVar[int]
    AUTOMATIC_FIELD_NUMBER: _ClassVar[int]
    PRIOR_NM2_FIELD_NUMBER: _ClassVar[int]
    WEIGHTING_FLUX_DN_FIELD_NUMBER: _ClassVar[int]
    GUARD_FIELD_NUMBER: _ClassVar[int]
    INTERLOCKS_ACTING_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: int
    mode: LoopMode
    calibration_id: str
    gain: _containers.RepeatedScalarFieldContainer[float]
    leak: _containers.RepeatedScalarFieldContainer[float]
    limit_nm: _containers.RepeatedScalarFieldContainer[float]
    delay_frames: float
    command_history_nm: _containers.RepeatedScalarFieldContainer[float]
    actuators: bytes
    offset: bytes
    counts: _containers.RepeatedCompositeFieldContainer[ReasonCount]
    frames_used: int
    frame_timestamp: _timestamp_pb2.Timestamp
    refused: Reason
    refused_count: int
    limits_hit: _containers.RepeatedScalarFieldContainer[Reason]
    frame_timeout: bool
    commanded: bool
    input_number: int
    settings: ControllerSettings
    offset_nm: _containers.RepeatedScalarFieldContainer[float]
    channels: _containers.RepeatedCompositeFieldContainer[Channel]
    shift_history_nm: _containers.RepeatedScalarFieldContainer[float]
    law: LinearLaw
    law_state: _containers.RepeatedScalarFieldContainer[float]
    law_frames: int
    play: Play
    steps_left: int
    returning_to_zero: bool
    measured_nm: _containers.RepeatedScalarFieldContainer[float]
    flux_dn: float
    identical_frames: int
    camera: CameraState
    camera_expected: CameraState
    camera_awaited: bool
    clear_id: int
    mode_timestamp: _timestamp_pb2.Timestamp
    mode_cause: str
    lease: Lease
    mirror_rows: int
    mirror_columns: int
    mirror_fault: str
    calibration_provisional: bool
    automatic: _containers.RepeatedScalarFieldContainer[bool]
    prior_nm2: _containers.RepeatedScalarFieldContainer[float]
    weighting_flux_dn: float
    guard: Guard
    interlocks_acting: _containers.RepeatedCompositeFieldContainer[ActingInterlock]
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[int] = ..., mode: _Optional[_Union[LoopMode, str]] = ..., calibration_id: _Optional[str] = ..., gain: _Optional[_Iterable[float]] = ..., leak: _Optional[_Iterable[float]] = ..., limit_nm: _Optional[_Iterable[float]] = ..., delay_frames: _Optional[float] = ..., command_history_nm: _Optional[_Iterable[float]] = ..., actuators: _Optional[bytes] = ..., offset: _Optional[bytes] = ..., counts: _Optional[_Iterable[_Union[ReasonCount, _Mapping]]] = ..., frames_used: _Optional[int] = ..., frame_timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., refused: _Optional[_Union[Reason, str]] = ..., refused_count: _Optional[int] = ..., limits_hit: _Optional[_Iterable[_Union[Reason, str]]] = ..., frame_timeout: _Optional[bool] = ..., commanded: _Optional[bool] = ..., input_number: _Optional[int] = ..., settings: _Optional[_Union[ControllerSettings, _Mapping]] = ..., offset_nm: _Optional[_Iterable[float]] = ..., channels: _Optional[_Iterable[_Union[Channel, _Mapping]]] = ..., shift_history_nm: _Optional[_Iterable[float]] = ..., law: _Optional[_Union[LinearLaw, _Mapping]] = ..., law_state: _Optional[_Iterable[float]] = ..., law_frames: _Optional[int] = ..., play: _Optional[_Union[Play, _Mapping]] = ..., steps_left: _Optional[int] = ..., returning_to_zero: _Optional[bool] = ..., measured_nm: _Optional[_Iterable[float]] = ..., flux_dn: _Optional[float] = ..., identical_frames: _Optional[int] = ..., camera: _Optional[_Union[CameraState, _Mapping]] = ..., camera_expected: _Optional[_Union[CameraState, _Mapping]] = ..., camera_awaited: _Optional[bool] = ..., clear_id: _Optional[int] = ..., mode_timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., mode_cause: _Optional[str] = ..., lease: _Optional[_Union[Lease, _Mapping]] = ..., mirror_rows: _Optional[int] = ..., mirror_columns: _Optional[int] = ..., mirror_fault: _Optional[str] = ..., calibration_provisional: _Optional[bool] = ..., automatic: _Optional[_Iterable[bool]] = ..., prior_nm2: _Optional[_Iterable[float]] = ..., weighting_flux_dn: _Optional[float] = ..., guard: _Optional[_Union[Guard, _Mapping]] = ..., interlocks_acting: _Optional[_Iterable[_Union[ActingInterlock, _Mapping]]] = ...) -> None: ...

class Guard(_message.Message):
    __slots__ = ("groups", "frames", "sums_nm2", "void", "virtual_nm", "law_state")
    GROUPS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    SUMS_NM2_FIELD_NUMBER: _ClassVar[int]
    VOID_FIELD_NUMBER: _ClassVar[int]
    VIRTUAL_NM_FIELD_NUMBER: _ClassVar[int]
    LAW_STATE_FIELD_NUMBER: _ClassVar[int]
    groups: _containers.RepeatedCompositeFieldContainer[GuardedGroup]
    frames: int
    sums_nm2: _containers.RepeatedScalarFieldContainer[float]
    void: bool
    virtual_nm: _containers.RepeatedScalarFieldContainer[float]
    law_state: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, groups: _Optional[_Iterable[_Union[GuardedGroup, _Mapping]]] = ..., frames: _Optional[int] = ..., sums_nm2: _Optional[_Iterable[float]] = ..., void: _Optional[bool] = ..., virtual_nm: _Optional[_Iterable[float]] = ..., law_state: _Optional[_Iterable[float]] = ...) -> None: ...

class GuardedGroup(_message.Message):
    __slots__ = ("overruled", "faded", "takeovers", "blocks", "usual_nm2")
    OVERRULED_FIELD_NUMBER: _ClassVar[int]
    FADED_FIELD_NUMBER: _ClassVar[int]
    TAKEOVERS_FIELD_NUMBER: _ClassVar[int]
    BLOCKS_FIELD_NUMBER: _ClassVar[int]
    USUAL_NM2_FIELD_NUMBER: _ClassVar[int]
    overruled: bool
    faded: int
    takeovers: int
    blocks: int
    usual_nm2: float
    def __init__(self, overruled: _Optional[bool] = ..., faded: _Optional[int] = ..., takeovers: _Optional[int] = ..., blocks: _Optional[int] = ..., usual_nm2: _Optional[float] = ...) -> None: ...

class Lease(_message.Message):
    __slots__ = ("id", "holder", "until", "last_sequence", "ended", "holds")
    ID_FIELD_NUMBER: _ClassVar[int]
    HOLDER_FIELD_NUMBER: _ClassVar[int]
    UNTIL_FIELD_NUMBER: _ClassVar[int]
    LAST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    HOLDS_FIELD_NUMBER: _ClassVar[int]
    id: int
    holder: str
    until: _timestamp_pb2.Timestamp
    last_sequence: int
    ended: str
    holds: bool
    def __init__(self, id: _Optional[int] = ..., holder: _Optional[str] = ..., until: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., last_sequence: _Optional[int] = ..., ended: _Optional[str] = ..., holds: _Optional[bool] = ...) -> None: ...

class Request(_message.Message):
    __slots__ = ("timestamp", "name", "modes", "values", "text", "accepted", "reply", "frame_sequence", "state", "input_number", "actuators", "table", "columns", "law", "calibration", "play_id", "lease_id", "requester", "prior_nm2", "flux_dn")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    MODES_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REPLY_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    INPUT_NUMBER_FIELD_NUMBER: _ClassVar[int]
    ACTUATORS_FIELD_NUMBER: _ClassVar[int]
    TABLE_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    LAW_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    PLAY_ID_FIELD_NUMBER: _ClassVar[int]
    LEASE_ID_FIELD_NUMBER: _ClassVar[int]
    REQUESTER_FIELD_NUMBER: _ClassVar[int]
    PRIOR_NM2_FIELD_NUMBER: _ClassVar[int]
    FLUX_DN_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    name: str
    modes: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    text: str
    accepted: bool
    reply: str
    frame_sequence: int
    state: ControllerState
    input_number: int
    actuators: bytes
    table: bytes
    columns: int
    law: LinearLaw
    calibration: Calibration
    play_id: str
    lease_id: int
    requester: str
    prior_nm2: _containers.RepeatedScalarFieldContainer[float]
    flux_dn: float
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., name: _Optional[str] = ..., modes: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[float]] = ..., text: _Optional[str] = ..., accepted: _Optional[bool] = ..., reply: _Optional[str] = ..., frame_sequence: _Optional[int] = ..., state: _Optional[_Union[ControllerState, _Mapping]] = ..., input_number: _Optional[int] = ..., actuators: _Optional[bytes] = ..., table: _Optional[bytes] = ..., columns: _Optional[int] = ..., law: _Optional[_Union[LinearLaw, _Mapping]] = ..., calibration: _Optional[_Union[Calibration, _Mapping]] = ..., play_id: _Optional[str] = ..., lease_id: _Optional[int] = ..., requester: _Optional[str] = ..., prior_nm2: _Optional[_Iterable[float]] = ..., flux_dn: _Optional[float] = ...) -> None: ...

class MirrorCommand(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "channel", "valid_for_ns", "rows", "columns", "actuators", "command_nm", "input_number", "safe", "clear_id")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    VALID_FOR_NS_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    ACTUATORS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_NM_FIELD_NUMBER: _ClassVar[int]
    INPUT_NUMBER_FIELD_NUMBER: _ClassVar[int]
    SAFE_FIELD_NUMBER: _ClassVar[int]
    CLEAR_ID_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: int
    channel: str
    valid_for_ns: int
    rows: int
    columns: int
    actuators: bytes
    command_nm: _containers.RepeatedScalarFieldContainer[float]
    input_number: int
    safe: bool
    clear_id: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[int] = ..., channel: _Optional[str] = ..., valid_for_ns: _Optional[int] = ..., rows: _Optional[int] = ..., columns: _Optional[int] = ..., actuators: _Optional[bytes] = ..., command_nm: _Optional[_Iterable[float]] = ..., input_number: _Optional[int] = ..., safe: _Optional[bool] = ..., clear_id: _Optional[int] = ...) -> None: ...

class MirrorState(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "status", "rows", "columns", "actuators", "command_nm", "limits_hit", "channels", "safe", "refused")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    ACTUATORS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_NM_FIELD_NUMBER: _ClassVar[int]
    LIMITS_HIT_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    SAFE_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: int
    status: MirrorStatus
    rows: int
    columns: int
    actuators: bytes
    command_nm: _containers.RepeatedScalarFieldContainer[float]
    limits_hit: _containers.RepeatedScalarFieldContainer[Reason]
    channels: _containers.RepeatedScalarFieldContainer[str]
    safe: bool
    refused: Reason
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[int] = ..., status: _Optional[_Union[MirrorStatus, str]] = ..., rows: _Optional[int] = ..., columns: _Optional[int] = ..., actuators: _Optional[bytes] = ..., command_nm: _Optional[_Iterable[float]] = ..., limits_hit: _Optional[_Iterable[_Union[Reason, str]]] = ..., channels: _Optional[_Iterable[str]] = ..., safe: _Optional[bool] = ..., refused: _Optional[_Union[Reason, str]] = ...) -> None: ...

class Truth(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "disturbance_nm", "residual_nm", "disturbance_rms_nm", "residual_rms_nm", "instants", "continuous_disturbance_nm", "continuous_residual_nm", "continuous_disturbance_rms_nm", "continuous_residual_rms_nm", "sensed_residual_nm", "added_contrast_flat", "added_contrast", "wheel_speed_hz", "shear_diameters")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DISTURBANCE_NM_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_NM_FIELD_NUMBER: _ClassVar[int]
    DISTURBANCE_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    INSTANTS_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_DISTURBANCE_NM_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_RESIDUAL_NM_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_DISTURBANCE_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_RESIDUAL_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    SENSED_RESIDUAL_NM_FIELD_NUMBER: _ClassVar[int]
    ADDED_CONTRAST_FLAT_FIELD_NUMBER: _ClassVar[int]
    ADDED_CONTRAST_FIELD_NUMBER: _ClassVar[int]
    WHEEL_SPEED_HZ_FIELD_NUMBER: _ClassVar[int]
    SHEAR_DIAMETERS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: int
    disturbance_nm: _containers.RepeatedScalarFieldContainer[float]
    residual_nm: _containers.RepeatedScalarFieldContainer[float]
    disturbance_rms_nm: float
    residual_rms_nm: float
    instants: int
    continuous_disturbance_nm: _containers.RepeatedScalarFieldContainer[float]
    continuous_residual_nm: _containers.RepeatedScalarFieldContainer[float]
    continuous_disturbance_rms_nm: float
    continuous_residual_rms_nm: float
    sensed_residual_nm: _containers.RepeatedScalarFieldContainer[float]
    added_contrast_flat: float
    added_contrast: float
    wheel_speed_hz: _containers.RepeatedScalarFieldContainer[float]
    shear_diameters: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[int] = ..., disturbance_nm: _Optional[_Iterable[float]] = ..., residual_nm: _Optional[_Iterable[float]] = ..., disturbance_rms_nm: _Optional[float] = ..., residual_rms_nm: _Optional[float] = ..., instants: _Optional[int] = ..., continuous_disturbance_nm: _Optional[_Iterable[float]] = ..., continuous_residual_nm: _Optional[_Iterable[float]] = ..., continuous_disturbance_rms_nm: _Optional[float] = ..., continuous_residual_rms_nm: _Optional[float] = ..., sensed_residual_nm: _Optional[_Iterable[float]] = ..., added_contrast_flat: _Optional[float] = ..., added_contrast: _Optional[float] = ..., wheel_speed_hz: _Optional[_Iterable[float]] = ..., shear_diameters: _Optional[_Iterable[float]] = ...) -> None: ...

class Calibration(_message.Message):
    __slots__ = ("timestamp", "id", "operator_hash", "estimator", "noll", "mode_names", "wavelength_nm", "rows", "columns", "reference", "response", "reconstructor", "mask", "dark", "flux_dn", "saturation_dn", "mirror_rows", "mirror_columns", "modes_to_actuators", "actuators_to_modes", "camera")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    OPERATOR_HASH_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    NOLL_FIELD_NUMBER: _ClassVar[int]
    MODE_NAMES_FIELD_NUMBER: _ClassVar[int]
    WAVELENGTH_NM_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    RECONSTRUCTOR_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    DARK_FIELD_NUMBER: _ClassVar[int]
    FLUX_DN_FIELD_NUMBER: _ClassVar[int]
    SATURATION_DN_FIELD_NUMBER: _ClassVar[int]
    MIRROR_ROWS_FIELD_NUMBER: _ClassVar[int]
    MIRROR_COLUMNS_FIELD_NUMBER: _ClassVar[int]
    MODES_TO_ACTUATORS_FIELD_NUMBER: _ClassVar[int]
    ACTUATORS_TO_MODES_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    id: str
    operator_hash: str
    estimator: str
    noll: _containers.RepeatedScalarFieldContainer[int]
    mode_names: _containers.RepeatedScalarFieldContainer[str]
    wavelength_nm: float
    rows: int
    columns: int
    reference: bytes
    response: bytes
    reconstructor: bytes
    mask: bytes
    dark: bytes
    flux_dn: float
    saturation_dn: float
    mirror_rows: int
    mirror_columns: int
    modes_to_actuators: bytes
    actuators_to_modes: bytes
    camera: CameraState
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., id: _Optional[str] = ..., operator_hash: _Optional[str] = ..., estimator: _Optional[str] = ..., noll: _Optional[_Iterable[int]] = ..., mode_names: _Optional[_Iterable[str]] = ..., wavelength_nm: _Optional[float] = ..., rows: _Optional[int] = ..., columns: _Optional[int] = ..., reference: _Optional[bytes] = ..., response: _Optional[bytes] = ..., reconstructor: _Optional[bytes] = ..., mask: _Optional[bytes] = ..., dark: _Optional[bytes] = ..., flux_dn: _Optional[float] = ..., saturation_dn: _Optional[float] = ..., mirror_rows: _Optional[int] = ..., mirror_columns: _Optional[int] = ..., modes_to_actuators: _Optional[bytes] = ..., actuators_to_modes: _Optional[bytes] = ..., camera: _Optional[_Union[CameraState, _Mapping]] = ...) -> None: ...

class ModalOffload(_message.Message):
    __slots__ = ("timestamp", "frame_sequence", "noll", "command_nm", "frames")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    NOLL_FIELD_NUMBER: _ClassVar[int]
    COMMAND_NM_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    frame_sequence: int
    noll: _containers.RepeatedScalarFieldContainer[int]
    command_nm: _containers.RepeatedScalarFieldContainer[float]
    frames: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frame_sequence: _Optional[int] = ..., noll: _Optional[_Iterable[int]] = ..., command_nm: _Optional[_Iterable[float]] = ..., frames: _Optional[int] = ...) -> None: ...

class TopicCount(_message.Message):
    __slots__ = ("topic", "published", "received", "skipped", "missing", "last_sequence")
    TOPIC_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    MISSING_FIELD_NUMBER: _ClassVar[int]
    LAST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    topic: str
    published: int
    received: int
    skipped: int
    missing: int
    last_sequence: int
    def __init__(self, topic: _Optional[str] = ..., published: _Optional[int] = ..., received: _Optional[int] = ..., skipped: _Optional[int] = ..., missing: _Optional[int] = ..., last_sequence: _Optional[int] = ...) -> None: ...

class Latency(_message.Message):
    __slots__ = ("count", "p50_ns", "p99_ns", "p99_9_ns", "max_ns")
    COUNT_FIELD_NUMBER: _ClassVar[int]
    P50_NS_FIELD_NUMBER: _ClassVar[int]
    P99_NS_FIELD_NUMBER: _ClassVar[int]
    P99_9_NS_FIELD_NUMBER: _ClassVar[int]
    MAX_NS_FIELD_NUMBER: _ClassVar[int]
    count: int
    p50_ns: int
    p99_ns: int
    p99_9_ns: int
    max_ns: int
    def __init__(self, count: _Optional[int] = ..., p50_ns: _Optional[int] = ..., p99_ns: _Optional[int] = ..., p99_9_ns: _Optional[int] = ..., max_ns: _Optional[int] = ...) -> None: ...

class WavefrontFigures(_message.Message):
    __slots__ = ("disturbance_rms_nm", "residual_rms_nm", "tilt_disturbance_mas", "tilt_residual_mas", "instants", "continuous_disturbance_rms_nm", "continuous_residual_rms_nm", "continuous_tilt_disturbance_mas", "continuous_tilt_residual_mas", "added_contrast_flat", "added_contrast", "science_images", "quadratic_added_contrast", "dark_zone_contrast", "costliest_modes", "costliest_share")
    DISTURBANCE_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    TILT_DISTURBANCE_MAS_FIELD_NUMBER: _ClassVar[int]
    TILT_RESIDUAL_MAS_FIELD_NUMBER: _ClassVar[int]
    INSTANTS_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_DISTURBANCE_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_RESIDUAL_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_TILT_DISTURBANCE_MAS_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_TILT_RESIDUAL_MAS_FIELD_NUMBER: _ClassVar[int]
    ADDED_CONTRAST_FLAT_FIELD_NUMBER: _ClassVar[int]
    ADDED_CONTRAST_FIELD_NUMBER: _ClassVar[int]
    SCIENCE_IMAGES_FIELD_NUMBER: _ClassVar[int]
    QUADRATIC_ADDED_CONTRAST_FIELD_NUMBER: _ClassVar[int]
    DARK_ZONE_CONTRAST_FIELD_NUMBER: _ClassVar[int]
    COSTLIEST_MODES_FIELD_NUMBER: _ClassVar[int]
    COSTLIEST_SHARE_FIELD_NUMBER: _ClassVar[int]
    disturbance_rms_nm: float
    residual_rms_nm: float
    tilt_disturbance_mas: float
    tilt_residual_mas: float
    instants: int
    continuous_disturbance_rms_nm: float
    continuous_residual_rms_nm: float
    continuous_tilt_disturbance_mas: float
    continuous_tilt_residual_mas: float
    added_contrast_flat: float
    added_contrast: float
    science_images: int
    quadratic_added_contrast: float
    dark_zone_contrast: float
    costliest_modes: str
    costliest_share: float
    def __init__(self, disturbance_rms_nm: _Optional[float] = ..., residual_rms_nm: _Optional[float] = ..., tilt_disturbance_mas: _Optional[float] = ..., tilt_residual_mas: _Optional[float] = ..., instants: _Optional[int] = ..., continuous_disturbance_rms_nm: _Optional[float] = ..., continuous_residual_rms_nm: _Optional[float] = ..., continuous_tilt_disturbance_mas: _Optional[float] = ..., continuous_tilt_residual_mas: _Optional[float] = ..., added_contrast_flat: _Optional[float] = ..., added_contrast: _Optional[float] = ..., science_images: _Optional[int] = ..., quadratic_added_contrast: _Optional[float] = ..., dark_zone_contrast: _Optional[float] = ..., costliest_modes: _Optional[str] = ..., costliest_share: _Optional[float] = ...) -> None: ...

class Recording(_message.Message):
    __slots__ = ("file", "messages", "lost", "bytes", "failure", "files", "stopped", "folder")
    FILE_FIELD_NUMBER: _ClassVar[int]
    MESSAGES_FIELD_NUMBER: _ClassVar[int]
    LOST_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    FAILURE_FIELD_NUMBER: _ClassVar[int]
    FILES_FIELD_NUMBER: _ClassVar[int]
    STOPPED_FIELD_NUMBER: _ClassVar[int]
    FOLDER_FIELD_NUMBER: _ClassVar[int]
    file: str
    messages: int
    lost: int
    bytes: int
    failure: str
    files: _containers.RepeatedScalarFieldContainer[str]
    stopped: bool
    folder: str
    def __init__(self, file: _Optional[str] = ..., messages: _Optional[int] = ..., lost: _Optional[int] = ..., bytes: _Optional[int] = ..., failure: _Optional[str] = ..., files: _Optional[_Iterable[str]] = ..., stopped: _Optional[bool] = ..., folder: _Optional[str] = ...) -> None: ...

class LoopFigures(_message.Message):
    __slots__ = ("frames", "residual_rms_nm", "flux_fraction")
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_RMS_NM_FIELD_NUMBER: _ClassVar[int]
    FLUX_FRACTION_FIELD_NUMBER: _ClassVar[int]
    frames: int
    residual_rms_nm: float
    flux_fraction: float
    def __init__(self, frames: _Optional[int] = ..., residual_rms_nm: _Optional[float] = ..., flux_fraction: _Optional[float] = ...) -> None: ...

class Health(_message.Message):
    __slots__ = ("timestamp", "process", "state", "run_id", "pid", "version", "memory_bytes", "rate_hz", "peers_alive", "topics", "realtime_granted", "realtime_refused", "clock_offset_ns", "uptime_ns", "frame_to_command", "frame_to_mirror", "wavefront", "recording", "mode", "counts", "commands_late", "mean_rate_hz", "router_offset_ns", "router_round_trip_ns", "not_closed_ns", "not_closed_cause", "command_refused", "command_expired", "limits_hit", "recent_wavefront", "last_second", "last_warning", "last_warning_timestamp", "host", "holding", "closing_harm", "driver_failures")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    PROCESS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MEMORY_BYTES_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    PEERS_ALIVE_FIELD_NUMBER: _ClassVar[int]
    TOPICS_FIELD_NUMBER: _ClassVar[int]
    REALTIME_GRANTED_FIELD_NUMBER: _ClassVar[int]
    REALTIME_REFUSED_FIELD_NUMBER: _ClassVar[int]
    CLOCK_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    UPTIME_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_TO_COMMAND_FIELD_NUMBER: _ClassVar[int]
    FRAME_TO_MIRROR_FIELD_NUMBER: _ClassVar[int]
    WAVEFRONT_FIELD_NUMBER: _ClassVar[int]
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    COUNTS_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_LATE_FIELD_NUMBER: _ClassVar[int]
    MEAN_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    ROUTER_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    ROUTER_ROUND_TRIP_NS_FIELD_NUMBER: _ClassVar[int]
    NOT_CLOSED_NS_FIELD_NUMBER: _ClassVar[int]
    NOT_CLOSED_CAUSE_FIELD_NUMBER: _ClassVar[int]
    COMMAND_REFUSED_FIELD_NUMBER: _ClassVar[int]
    COMMAND_EXPIRED_FIELD_NUMBER: _ClassVar[int]
    LIMITS_HIT_FIELD_NUMBER: _ClassVar[int]
    RECENT_WAVEFRONT_FIELD_NUMBER: _ClassVar[int]
    LAST_SECOND_FIELD_NUMBER: _ClassVar[int]
    LAST_WARNING_FIELD_NUMBER: _ClassVar[int]
    LAST_WARNING_TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    HOLDING_FIELD_NUMBER: _ClassVar[int]
    CLOSING_HARM_FIELD_NUMBER: _ClassVar[int]
    DRIVER_FAILURES_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    process: str
    state: str
    run_id: str
    pid: int
    version: str
    memory_bytes: int
    rate_hz: float
    peers_alive: _containers.RepeatedScalarFieldContainer[str]
    topics: _containers.RepeatedCompositeFieldContainer[TopicCount]
    realtime_granted: _containers.RepeatedScalarFieldContainer[str]
    realtime_refused: _containers.RepeatedScalarFieldContainer[str]
    clock_offset_ns: int
    uptime_ns: int
    frame_to_command: Latency
    frame_to_mirror: Latency
    wavefront: WavefrontFigures
    recording: Recording
    mode: LoopMode
    counts: _containers.RepeatedCompositeFieldContainer[ReasonCount]
    commands_late: int
    mean_rate_hz: float
    router_offset_ns: int
    router_round_trip_ns: int
    not_closed_ns: int
    not_closed_cause: str
    command_refused: Reason
    command_expired: bool
    limits_hit: _containers.RepeatedScalarFieldContainer[Reason]
    recent_wavefront: WavefrontFigures
    last_second: LoopFigures
    last_warning: str
    last_warning_timestamp: _timestamp_pb2.Timestamp
    host: str
    holding: str
    closing_harm: str
    driver_failures: int
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., process: _Optional[str] = ..., state: _Optional[str] = ..., run_id: _Optional[str] = ..., pid: _Optional[int] = ..., version: _Optional[str] = ..., memory_bytes: _Optional[int] = ..., rate_hz: _Optional[float] = ..., peers_alive: _Optional[_Iterable[str]] = ..., topics: _Optional[_Iterable[_Union[TopicCount, _Mapping]]] = ..., realtime_granted: _Optional[_Iterable[str]] = ..., realtime_refused: _Optional[_Iterable[str]] = ..., clock_offset_ns: _Optional[int] = ..., uptime_ns: _Optional[int] = ..., frame_to_command: _Optional[_Union[Latency, _Mapping]] = ..., frame_to_mirror: _Optional[_Union[Latency, _Mapping]] = ..., wavefront: _Optional[_Union[WavefrontFigures, _Mapping]] = ..., recording: _Optional[_Union[Recording, _Mapping]] = ..., mode: _Optional[_Union[LoopMode, str]] = ..., counts: _Optional[_Iterable[_Union[ReasonCount, _Mapping]]] = ..., commands_late: _Optional[int] = ..., mean_rate_hz: _Optional[float] = ..., router_offset_ns: _Optional[int] = ..., router_round_trip_ns: _Optional[int] = ..., not_closed_ns: _Optional[int] = ..., not_closed_cause: _Optional[str] = ..., command_refused: _Optional[_Union[Reason, str]] = ..., command_expired: _Optional[bool] = ..., limits_hit: _Optional[_Iterable[_Union[Reason, str]]] = ..., recent_wavefront: _Optional[_Union[WavefrontFigures, _Mapping]] = ..., last_second: _Optional[_Union[LoopFigures, _Mapping]] = ..., last_warning: _Optional[str] = ..., last_warning_timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., host: _Optional[str] = ..., holding: _Optional[str] = ..., closing_harm: _Optional[str] = ..., driver_failures: _Optional[int] = ...) -> None: ...
