"""Past values from the history service."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import datetime, timezone
from typing import Dict, List, Optional, Tuple, Union
from urllib.parse import quote

from .bus import DEFAULT_ENDPOINT, DEFAULT_ROOT, Certificate, Connect, check_name, key
from .bus import owned_or_shared
from .errors import InvalidMessage, NoReply, QueryRejected, UnsupportedVersion
from .messages import from_json

#: Encoding of the reply.
ENCODING = "application/json;spandrel.history-span.v1"

#: A time with a time zone, seconds since the Unix epoch, or a text such as `2026-03-01T12:00:00Z`.
Time = Union[datetime, float, int, str]


@dataclass(frozen=True)
class Point:
    """Values of a quantity in one interval of time."""

    #: Time of the last value, in seconds since the Unix epoch.
    time_s: float
    #: Number of values.
    count: int
    mean: float
    #: Root of the mean variance.
    std: float
    #: Standard deviation of the means.
    spread: float
    #: Least and largest mean.
    least: float
    largest: float
    #: Ends of the 95 % intervals.
    low: float
    high: float
    #: Largest probability of a loss. `None` unless the kind is `loss`.
    probability_of_loss: Optional[float]

    @property
    def time(self) -> datetime:
        """Time of the last value, UTC."""
        return datetime.fromtimestamp(self.time_s, timezone.utc)


@dataclass(frozen=True)
class History:
    """Past values of a quantity, oldest first."""

    structure: str
    kind: str
    name: str
    #: Length of the intervals in seconds, or `None` for values as displayed.
    resolution_s: Optional[int]
    #: Time of the first stored value, in seconds since the Unix epoch.
    kept_from_s: Optional[float]
    points: Tuple[Point, ...]


@dataclass(frozen=True)
class _Rows:
    time_s: Tuple[float, ...]
    count: Tuple[int, ...]
    mean: Tuple[float, ...]
    std: Tuple[float, ...]
    spread: Tuple[float, ...]
    least: Tuple[float, ...]
    largest: Tuple[float, ...]
    low: Tuple[float, ...]
    high: Tuple[float, ...]
    probability_of_loss: Tuple[float, ...]


@dataclass(frozen=True)
class _Span:
    structure: str
    kind: str
    name: str
    resolution_s: Optional[int]
    kept_from_s: Optional[float]
    rows: _Rows


def history(
    structure: str,
    name: str,
    start: Optional[Time] = None,
    end: Optional[Time] = None,
    *,
    kind: str = "parameter",
    points: int = 1000,
    connect: Connect = DEFAULT_ENDPOINT,
    certificate: Optional[Certificate] = None,
    root: str = DEFAULT_ROOT,
    timeout: float = 10.0,
) -> History:
    """Returns the past values of a parameter, loss, noise level, channel, class, node, condition or mode.

    `kind` is `parameter`, `loss`, `noise`, `outlier`, `class`, `node`, `condition` or `mode`. `points` is the
    maximum number of points, 1 to 20,000. The history combines values if the period contains more.

    Raises `NoReply` if no history replies within `timeout` seconds. `spandrel run` and
    `spandrel history` keep a history, `spandrel demo` does not. Raises `QueryRejected` if the
    history rejects the query, for example because of an unknown name.
    """
    check_name("name", name)
    parameters: Dict[str, str] = {"kind": kind, "points": str(points)}
    if start is not None:
        parameters["from"] = _time_text("start", start)
    if end is not None:
        parameters["to"] = _time_text("end", end)
    query = ";".join(f"{parameter}={value}" for parameter, value in parameters.items())
    selector = f"{key(root, structure, f'history/{name}')}?{query}"
    session, is_owned = owned_or_shared(connect, certificate, timeout)
    try:
        rejected: List[str] = []
        for reply in session.get(selector, timeout=timeout):
            if reply.ok is not None:
                encoding = str(reply.ok.encoding)
                return _read(str(reply.ok.key_expr), encoding, reply.ok.payload.to_bytes())
            if reply.err is not None:
                rejected.append(reply.err.payload.to_string())
    finally:
        if is_owned:
            session.close()
    if rejected and rejected[0] != "Timeout":
        raise QueryRejected(f"history of {structure}: {rejected[0]}")
    raise NoReply(
        f"no history of {structure} replied within {timeout:g} s; spandrel run and spandrel history "
        "keep a history, spandrel demo does not"
    )


def _time_text(what: str, time: Time) -> str:
    if isinstance(time, datetime):
        if time.tzinfo is None:
            raise ValueError(f"{what} is {time.isoformat()}, must have a time zone")
        return time.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    if isinstance(time, str):
        # `;` and `=` would begin another parameter of the query.
        return quote(time, safe=":+-.TZ ")
    return repr(float(time))


def _read(where: str, encoding: str, payload: bytes) -> History:
    if encoding not in (ENCODING, "application/json"):
        raise UnsupportedVersion(
            f"{where}: encoding is {encoding!r}, this package supports {ENCODING!r}; update the older of both"
        )
    span = from_json(_Span, payload, where)
    columns = {column.name: getattr(span.rows, column.name) for column in fields(_Rows)}
    lengths = {len(column) for column in columns.values()}
    has_losses = span.kind == "loss"
    if len(lengths) > 1:
        raise InvalidMessage(f"{where}: the columns have different lengths: {sorted(lengths)}")
    rows = zip(*columns.values())
    points = (Point(**dict(zip(columns, row))) for row in rows)
    if not has_losses:
        points = (Point(**{**vars(point), "probability_of_loss": None}) for point in points)
    return History(
        structure=span.structure,
        kind=span.kind,
        name=span.name,
        resolution_s=span.resolution_s,
        kept_from_s=span.kept_from_s,
        points=tuple(points),
    )
