"""Display messages as dataclasses. docs/topics.md describes every field.

Times are in ns since the Unix epoch (UTC). Parameters are ratios to the nominal value.
"""

from __future__ import annotations

import json
import logging
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Any, ClassVar, Dict, List, Mapping, Optional, Set, Tuple, Type, TypeVar, Union
from typing import get_args, get_origin, get_type_hints

from .errors import InvalidMessage, UnsupportedVersion

_log = logging.getLogger("spandrel")
_T = TypeVar("_T")


@dataclass(frozen=True)
class Interval:
    """Credible interval that contains the value with the probability `level`."""

    level: float
    low: float
    high: float


@dataclass(frozen=True)
class Parameter:
    """Estimate of a stiffness parameter."""

    TYPE: ClassVar[str] = "parameter"
    VERSION: ClassVar[int] = 2
    KEY: ClassVar[str] = "parameter/{parameter}"

    structure: str
    parameter: str
    time_ns: int
    mean: float
    std: float
    interval: Interval


@dataclass(frozen=True)
class Loss:
    """Loss of stiffness on which an alert is decided, as a share of the reference."""

    TYPE: ClassVar[str] = "loss"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "loss/{parameter}"

    structure: str
    parameter: str
    time_ns: int
    loss: float
    interval: Interval
    #: Probability that the loss exceeds `rule_loss`.
    probability_of_loss: float
    rule_loss: float
    rule_credibility: float
    reference: float
    reference_std: float


@dataclass(frozen=True)
class Noise:
    """Noise level that the filter adapts: the variance of one sample."""

    TYPE: ClassVar[str] = "noise"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "noise/{name}"

    structure: str
    name: str
    time_ns: int
    mean: float
    std: float


@dataclass(frozen=True)
class MaskedSpan:
    """Period in which every sample was rejected."""

    from_ns: int
    to_ns: int
    samples: int


@dataclass(frozen=True)
class Outlier:
    """Outlier screening of a channel. `state` is `training`, `screening` or `faulty`."""

    TYPE: ClassVar[str] = "outlier"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "outlier/{channel}"

    structure: str
    channel: str
    time_ns: int
    state: str
    flagged: int
    rejected: int
    screened: int
    recent_share: float
    scale: float
    masked: Optional[MaskedSpan]


@dataclass(frozen=True)
class ChannelHealth:
    """Comparison of one channel with the others.

    `state` is `unchecked`, `sound`, `in-doubt` or `faulty`. `fault` is `gain`, `sign`, `delay`,
    `dead`, `disturbed`, `drift`, `clipped` or `exchanged`.
    """

    channel: str
    state: str
    probability: float
    fault: Optional[str]
    gain: Optional[float]
    delay_s: Optional[float]
    coherence: Optional[float]


@dataclass(frozen=True)
class SensorHealth:
    """Comparison of the sensors of a node with the others."""

    TYPE: ClassVar[str] = "sensor-health"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "sensor/{node}/health"

    structure: str
    node: str
    time_ns: int
    channels: Tuple[ChannelHealth, ...]


@dataclass(frozen=True)
class SampleLevel:
    """Mean, root mean square about the mean, and last sample, in the unit of the channel."""

    mean: float
    rms: float
    last: float


@dataclass(frozen=True)
class ChannelWaveform:
    """The samples of one channel in about one second.

    `extremes` contains the minimum and maximum of each bucket, or None if it has no samples.
    """

    channel: str
    missing: int
    level: Optional[SampleLevel]
    extremes: Tuple[Optional[Tuple[float, ...]], ...]


@dataclass(frozen=True)
class Waveform:
    """The samples of a node in about one second, reduced to the extremes of short buckets."""

    TYPE: ClassVar[str] = "waveform"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "sensor/{node}/waveform"

    structure: str
    node: str
    time_ns: int
    frames: int
    bucket_s: float
    channels: Tuple[ChannelWaveform, ...]


@dataclass(frozen=True)
class ChannelSpectrum:
    """One-sided power spectral density of one channel, in its squared unit per Hz."""

    channel: str
    windows: int
    density: Tuple[float, ...]


@dataclass(frozen=True)
class Spectrum:
    """The spectra of the channels of a node in about the last minute."""

    TYPE: ClassVar[str] = "spectrum"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "sensor/{node}/spectrum"

    structure: str
    node: str
    time_ns: int
    window_s: float
    frequencies_hz: Tuple[float, ...]
    channels: Tuple[ChannelSpectrum, ...]


#: Units of conditions.
CONDITION_UNITS: Tuple[str, ...] = (
    "degC",
    "K",
    "%",
    "1",
    "m/s",
    "km/h",
    "deg",
    "rad",
    "mrad",
    "m",
    "cm",
    "mm",
    "um",
    "N",
    "kN",
    "MN",
    "N m",
    "kN m",
    "kg",
    "t",
    "Pa",
    "hPa",
    "kPa",
    "MPa",
    "m/s2",
    "microstrain",
    "W/m2",
    "mm/h",
    "Hz",
    "1/h",
    "V",
    "mV",
    "mA",
)


@dataclass(frozen=True)
class Condition:
    """Value of a condition, such as a temperature."""

    TYPE: ClassVar[str] = "condition"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "condition/{name}"

    structure: str
    name: str
    time_ns: int
    value: float
    unit: str
    #: Expected time until the next value, in seconds.
    interval_s: Optional[float] = None
    #: Label of the instrument.
    instrument: Optional[str] = None


@dataclass(frozen=True)
class LastingChange:
    """A lasting change that has been found."""

    kind: str
    found_ns: int
    since_ns: int
    #: Loss of stiffness as a share, negative for a gain.
    loss: float
    interval: Interval


@dataclass(frozen=True)
class ChangeSeen:
    """The person who has seen a lasting change."""

    who: str
    text: str
    time_ns: int


@dataclass(frozen=True)
class BudgetSpent:
    """The alarms of a structure, and the false alarms promised for the same time."""

    #: Number of days on which at least one quantity was judged.
    judged_days: int
    promised: float
    alarms: int
    alarms_in_last_year: int


@dataclass(frozen=True)
class DayExpectation:
    """Expected value of a day, and how far the measured value is from it."""

    measured: float
    expected: float
    interval: Interval
    residual: float
    ln_evidence: float
    ln_threshold: float
    cusum_share: float


@dataclass(frozen=True)
class EpochCondition:
    """A condition in an epoch."""

    name: str
    #: `degC`, `log10` of an amplitude, or empty.
    unit: str
    value: Optional[float]


@dataclass(frozen=True)
class Epoch:
    """One epoch of a quantity, as it is judged for lasting change."""

    TYPE: ClassVar[str] = "epoch"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "epoch/{quantity}"

    structure: str
    quantity: str
    #: Middle of the epoch.
    time_ns: int
    epoch_s: float
    #: Mean and standard deviation of ln(value). None if no value counts.
    ln_mean: Optional[float]
    ln_std: Optional[float]
    #: Logarithm of the rms response to base 10, if a condition is an amplitude.
    amplitude: Optional[float]
    conditions: Tuple[EpochCondition, ...]
    #: Whether all samples were measured.
    measured: bool


@dataclass(frozen=True)
class Judgement:
    """State of one quantity that is judged for lasting change."""

    TYPE: ClassVar[str] = "judgement"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "judgement/{quantity}"

    structure: str
    quantity: str
    time_ns: int
    day_ns: Optional[int]
    epoch_ns: Optional[int]
    epochs: int
    #: Whether all epochs contain measured samples.
    measured: bool
    state: str
    change: Optional[LastingChange]
    sentence: str
    expectation: Optional[DayExpectation]
    false_alarms_per_year: float
    #: The person who has seen the change, if somebody has.
    seen: Optional[ChangeSeen] = None
    #: What all quantities of the structure have spent of the budget.
    spent: Optional[BudgetSpent] = None
    #: Name of the configuration in force. None without a state folder.
    configuration: Optional[str] = None


@dataclass(frozen=True)
class ShapeValue:
    """A mode at one channel."""

    channel: str
    #: Real and imaginary part, relative to the channel with the largest amplitude.
    value: Tuple[float, ...]
    std: float


@dataclass(frozen=True)
class ModeEstimate:
    """A mode as it was found in one epoch. Frequencies are in Hz."""

    frequency_hz: float
    frequency_std_hz: float
    damping: float
    damping_std: float
    shape: Tuple[ShapeValue, ...]
    #: Standard deviation of the channel with the largest amplitude, in the band of the mode.
    amplitude: float


@dataclass(frozen=True)
class Mode:
    """One declared mode after one epoch."""

    TYPE: ClassVar[str] = "mode"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "mode/{mode}"

    structure: str
    mode: str
    time_ns: int
    epoch_s: float
    epochs: int
    #: `tracked`, `missing`, `lost` or `paired`.
    state: str
    partner: Optional[str]
    #: `None` if the mode is missing or lost.
    estimate: Optional[ModeEstimate]
    presence: float
    #: Whether a machine runs at this frequency.
    machine: bool
    declared_hz: float


@dataclass(frozen=True)
class ClassPlausibility:
    """Plausibility of one model class, named `class` in the message."""

    model_class: str
    plausibility: float


@dataclass(frozen=True)
class ClassCalibration:
    """Latest calibration of the nominal model."""

    time_ns: int
    model_class: str
    change: float


@dataclass(frozen=True)
class ModelClass:
    """Plausibilities of the competing model classes."""

    TYPE: ClassVar[str] = "model-class"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "model-class"

    structure: str
    time_ns: int
    classes: Tuple[ClassPlausibility, ...]
    leading: str
    believed: str
    calibrations: int
    calibration: Optional[ClassCalibration]


@dataclass(frozen=True)
class ChannelFit:
    """Measures of the fit of one channel. A measure is `None` until it is known."""

    channel: str
    largest_autocorrelation: Optional[float]
    explained_share: Optional[float]
    excitation_correlation: Optional[float]
    noise_ratio: Optional[float]


@dataclass(frozen=True)
class Fit:
    """Whether the data support the model: `supported`, `doubtful` or `contradicted`."""

    TYPE: ClassVar[str] = "fit"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "fit"

    structure: str
    time_ns: int
    verdict: str
    reasons: Tuple[str, ...]
    follows_jump: bool
    channels: Tuple[ChannelFit, ...]


@dataclass(frozen=True)
class Node:
    """Sensor node as seen by the station: `used`, `silent`, `excluded` or `ended`."""

    TYPE: ClassVar[str] = "node"
    VERSION: ClassVar[int] = 2
    KEY: ClassVar[str] = "node/{node}"

    structure: str
    node: str
    time_ns: int
    state: str
    distance: Optional[float]
    distance_limit: Optional[float]
    weight: Optional[float]
    excluded_since_ns: Optional[int]
    silent_since_ns: Optional[int]
    heard_ns: Optional[int]
    excluded_share: float
    messages: int
    bytes_received: int
    bytes_sent: int
    refused: Mapping[str, int]
    restarts: int


@dataclass(frozen=True)
class Event:
    """Event such as a restart of the filter or an excluded channel."""

    TYPE: ClassVar[str] = "event"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "event"

    structure: str
    time_ns: int
    kind: str
    subject: str
    what: str
    why: str


@dataclass(frozen=True)
class Alert:
    """Decision about one parameter, with the reason in words in `why`."""

    TYPE: ClassVar[str] = "alert"
    VERSION: ClassVar[int] = 2
    KEY: ClassVar[str] = "alert/{parameter}"

    structure: str
    parameter: str
    time_ns: int
    state: str
    since_ns: Optional[int]
    rule_loss: float
    rule_credibility: float
    credibility: float
    loss: Optional[float]
    loss_interval: Optional[Interval]
    mean: float
    std: float
    reference: Optional[float]
    reference_std: Optional[float]
    acknowledged_by: Optional[str]
    why: str
    loss_interval_within_record: Optional[Interval] = None
    fit: Optional[str] = None
    fit_reasons: Tuple[str, ...] = ()
    follows_jump: bool = False
    undecided_because: Optional[str] = None
    revision: int = 0


@dataclass(frozen=True)
class ParameterMonitoring:
    """Whether a change of one parameter would be noticed now, and why not."""

    parameter: str
    state: str
    why: Optional[str]
    sustained_std: Optional[float]


@dataclass(frozen=True)
class ChannelMonitoring:
    """Share of the samples of one channel that the filter has used in the last 5 s."""

    channel: str
    state: str
    used_share: float


@dataclass(frozen=True)
class Monitoring:
    """Whether damage would be noticed now: `watching`, `degraded` or `blind`."""

    TYPE: ClassVar[str] = "monitoring"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "monitoring"

    structure: str
    time_ns: int
    measured_ns: Optional[int]
    state: str
    since_ns: int
    reasons: Tuple[str, ...]
    parameters: Tuple[ParameterMonitoring, ...]
    channels: Tuple[ChannelMonitoring, ...]


@dataclass(frozen=True)
class NodeClock:
    """Time from the frames to the samples of a node, and the variation of its time stamps.

    ``difference_s`` is the clock of the node minus the clock of most nodes, or ``None`` if they
    agree. ``quality_percent`` is the quality of the clock that its source states, if any.
    """

    offset_s: float
    jitter_s: float
    difference_s: Optional[float] = None
    quality_percent: Optional[int] = None


@dataclass(frozen=True)
class InstrumentStatus:
    """State and counts of an instrument that the feed connects."""

    state: str
    since_ns: int
    samples: int
    errors: int
    last_error: Optional[str] = None
    last_error_ns: Optional[int] = None


@dataclass(frozen=True)
class Maintenance:
    """A period during which the notices of a structure, or of one part, are muted."""

    structure: str
    time_ns: int
    until_ns: int
    who: str
    reason: str
    parameter: Optional[str] = None


@dataclass(frozen=True)
class Status:
    """State of a service, published once per second."""

    TYPE: ClassVar[str] = "status"
    VERSION: ClassVar[int] = 1
    KEY: ClassVar[str] = "status/{service}/{id}"

    structure: str
    service: str
    id: str
    time_ns: int
    lag_s: Optional[float]
    done: int
    drops: Mapping[str, int]
    restarts: int
    version: str
    pace: Optional[str] = None
    state: Optional[str] = None
    load: Optional[str] = None
    frames_behind: Optional[int] = None
    fit: Optional[str] = None
    undecided: Optional[Mapping[str, int]] = None
    instruments: Optional[Mapping[str, InstrumentStatus]] = None
    clocks: Optional[Mapping[str, NodeClock]] = None
    missing: Optional[Mapping[str, float]] = None
    maintenance: Optional[Tuple[Maintenance, ...]] = None


Message = Union[
    Parameter,
    Loss,
    Noise,
    Outlier,
    SensorHealth,
    Waveform,
    Spectrum,
    Condition,
    Epoch,
    Judgement,
    Mode,
    ModelClass,
    Fit,
    Monitoring,
    Node,
    Event,
    Alert,
    Status,
]

#: All types of display messages.
MESSAGES: Tuple[Type[Any], ...] = (
    Parameter,
    Loss,
    Noise,
    Outlier,
    SensorHealth,
    Waveform,
    Spectrum,
    Condition,
    Epoch,
    Judgement,
    Mode,
    ModelClass,
    Fit,
    Monitoring,
    Node,
    Event,
    Alert,
    Status,
)

#: Names of fields that are keywords in Python.
_RENAMED = {"model_class": "class"}


def encoding_of(kind: Type[Any]) -> str:
    """Returns the encoding of a type of messages, such as `application/json;spandrel.fit.v1`."""
    return f"application/json;spandrel.{kind.TYPE}.v{kind.VERSION}"


def decode(kind: Type[_T], key: str, encoding: str, payload: bytes) -> _T:
    """Decodes a message of one type that was received on `key`.

    Raises `UnsupportedVersion` for another encoding. Raises `InvalidMessage` if the message cannot
    be read, or if its content contradicts its key.
    """
    expected = encoding_of(kind)
    if encoding not in (expected, "application/json"):
        raise UnsupportedVersion(
            f"{key}: encoding is {encoding!r}, this package supports {expected!r}; update the older of both"
        )
    message = from_json(kind, payload, key)
    rest: str = getattr(kind, "KEY").format(**vars(message))
    structure = getattr(message, "structure")
    if not key.endswith(f"/{structure}/{rest}"):
        raise InvalidMessage(f"{key}: the message is about {structure}/{rest}")
    return message


def from_json(kind: Type[_T], payload: bytes, where: str) -> _T:
    """Reads one dataclass from JSON, or raises `InvalidMessage`. `where` names the source."""
    try:
        value = json.loads(payload)
    except ValueError as error:
        raise InvalidMessage(f"{where}: not JSON: {error}") from error
    try:
        message: _T = _convert(kind, value, kind.__name__)
    except _Mismatch as error:
        raise InvalidMessage(f"{where}: {error}") from error
    return message


class _Mismatch(Exception):
    """A value of another type."""


def _convert(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Union:  # an optional value
        if value is None:
            return None
        return _convert(arguments[0], value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise _Mismatch(f"{where} is {value!r:.80}, must be a list")
        return tuple(_convert(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if origin is not None:  # a mapping of texts to values
        if not isinstance(value, dict):
            raise _Mismatch(f"{where} is {value!r:.80}, must be an object")
        return {
            name: _convert(arguments[1], item, f"{where}.{name}") for name, item in value.items()
        }
    if is_dataclass(kind):
        return _convert_object(kind, value, where)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise _Mismatch(f"{where} is {value!r:.80}, must be {kind.__name__}")
    return value


#: Type hints of each dataclass. Computing them takes longer than reading a message.
_HINTS: Dict[Any, Dict[str, Any]] = {}
#: Unknown fields that were reported.
_REPORTED: Set[Tuple[str, str]] = set()


def _convert_object(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise _Mismatch(f"{where} is {value!r:.80}, must be an object")
    hints = _HINTS.get(kind)
    if hints is None:
        hints = _HINTS[kind] = get_type_hints(kind)
    left = dict(value)
    found: Dict[str, Any] = {}
    missing: List[str] = []
    for field in fields(kind):
        name = _RENAMED.get(field.name, field.name)
        if name in left:
            found[field.name] = _convert(hints[field.name], left.pop(name), f"{where}.{name}")
        elif get_origin(hints[field.name]) is Union:
            found[field.name] = None
        elif field.default is MISSING:
            missing.append(name)
    if missing:
        raise _Mismatch(f"{where} lacks {', '.join(missing)}")
    for name in left:
        if (kind.__name__, name) not in _REPORTED:
            _REPORTED.add((kind.__name__, name))
            _log.warning(
                "%s has the field %s, which this package does not know; it is ignored", where, name
            )
    return kind(**found)
