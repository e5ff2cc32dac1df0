"""Sensors, dashboards and scripts for Spandrel, a structural health monitoring daemon.

- `Sensor`: publishes the samples of a node, and keeps them for services that missed some
- `ConditionPublisher`: publishes a slow quantity, such as a temperature
- `subscribe`: receives parameters, losses, alerts, noise levels, fits, events and statuses
- `history`: queries past values
- `latest_alerts`, `acknowledge`: query and acknowledge alerts
- `open_session`: opens a session that several of these can share

The package uses Zenoh's own Python package. docs/topics.md of Spandrel describes all messages.
"""

from .alerts import acknowledge, latest_alerts
from .bus import DEFAULT_ENDPOINT, DEFAULT_ROOT, open_session
from .conditions import ConditionPublisher
from .errors import (
    Closed,
    InvalidMessage,
    InvalidName,
    InvalidSamples,
    NoReply,
    NotConnected,
    QueryRejected,
    SpandrelError,
    UnsupportedVersion,
)
from .past import History, Point, history
from .messages import (
    CONDITION_UNITS,
    MESSAGES,
    Alert,
    ChannelFit,
    ChannelHealth,
    ChannelMonitoring,
    ClassCalibration,
    ClassPlausibility,
    Condition,
    ChangeSeen,
    DayExpectation,
    Event,
    Fit,
    Interval,
    Judgement,
    LastingChange,
    Loss,
    MaskedSpan,
    Message,
    Mode,
    ModeEstimate,
    ModelClass,
    Monitoring,
    Node,
    NodeClock,
    Noise,
    Outlier,
    Parameter,
    ParameterMonitoring,
    SensorHealth,
    ShapeValue,
    Status,
)
from .sensor import SAMPLES_KEPT, Sensor
from .subscription import Subscription, subscribe

__all__ = [
    "CONDITION_UNITS",
    "DEFAULT_ENDPOINT",
    "DEFAULT_ROOT",
    "MESSAGES",
    "SAMPLES_KEPT",
    "Alert",
    "ChannelFit",
    "ChannelHealth",
    "ChannelMonitoring",
    "ClassCalibration",
    "ClassPlausibility",
    "Closed",
    "Condition",
    "ConditionPublisher",
    "ChangeSeen",
    "DayExpectation",
    "Event",
    "Fit",
    "History",
    "Interval",
    "InvalidMessage",
    "InvalidName",
    "InvalidSamples",
    "Judgement",
    "LastingChange",
    "Loss",
    "MaskedSpan",
    "Message",
    "Mode",
    "ModeEstimate",
    "ModelClass",
    "Monitoring",
    "NoReply",
    "Node",
    "NodeClock",
    "Noise",
    "NotConnected",
    "Outlier",
    "Parameter",
    "ParameterMonitoring",
    "Point",
    "QueryRejected",
    "Sensor",
    "SensorHealth",
    "ShapeValue",
    "SpandrelError",
    "Status",
    "Subscription",
    "UnsupportedVersion",
    "acknowledge",
    "history",
    "latest_alerts",
    "open_session",
    "subscribe",
]
