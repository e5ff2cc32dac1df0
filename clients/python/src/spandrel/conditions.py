"""Conditions: slow quantities such as temperatures."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from types import TracebackType
from typing import Any, Dict, Optional, Type

import zenoh

from .bus import DEFAULT_ENDPOINT, DEFAULT_ROOT, DEFAULT_TIMEOUT_S, Certificate, Connect
from .bus import check_name, key, owned_or_shared
from .errors import Closed
from .messages import CONDITION_UNITS, Condition, encoding_of

_log = logging.getLogger("spandrel")

#: Time to wait for a subscriber before the first value, in seconds.
_SUBSCRIBER_TIMEOUT_S = 2.0
#: Time between two looks for a subscriber, in seconds.
_LOOK_S = 0.05


class ConditionPublisher:
    """Publishes the values of one condition of a structure.

    The structure file must contain a `[[condition]]` of this name and unit. Use it in a `with`
    statement:

        with ConditionPublisher("demo", "deck-temperature", "degC", interval=600) as deck:
            deck.publish(21.5)

    - `structure`, `name`: the names in the structure file
    - `unit`: one of `CONDITION_UNITS`
    - `interval`: the expected time between two values, in seconds. A value is stale after twice
      this time.
    - `instrument`: a label of the instrument, for people
    - `connect`: an endpoint, or a session from `open_session`
    - `certificate`: the path of `gateway.STRUCTURE.pem` for an endpoint `quic/...`
    - `root`: the first chunk of all keys (`bus.root`)
    - `timeout`: the time to wait for the connection, in seconds

    Raises `NotConnected` if no program replies, and `InvalidName` or `ValueError` if an argument is
    not allowed. `publish` and `close` can be called from several threads.
    """

    def __init__(
        self,
        structure: str,
        name: str,
        unit: str,
        interval: Optional[float] = None,
        instrument: Optional[str] = None,
        connect: Connect = DEFAULT_ENDPOINT,
        certificate: Optional[Certificate] = None,
        root: str = DEFAULT_ROOT,
        *,
        timeout: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        check_name("condition", name)
        topic = key(root, structure, f"condition/{name}")
        if unit not in CONDITION_UNITS:
            raise ValueError(f"unit is {unit!r}, must be one of {', '.join(CONDITION_UNITS)}")
        if interval is not None and not 0 < interval < math.inf:
            raise ValueError(f"interval is {interval} s, must be a finite number above 0")
        self._message: Dict[str, Any] = {"structure": structure, "name": name, "unit": unit}
        if interval is not None:
            self._message["interval_s"] = float(interval)
        if instrument is not None:
            self._message["instrument"] = instrument
        self._lock = threading.Lock()
        self._is_closed = False
        self._has_waited = False
        self._session, self._owns_session = owned_or_shared(connect, certificate, timeout)
        self._publisher = self._session.declare_publisher(
            topic,
            encoding=encoding_of(Condition),
            # There is no later value that would replace a dropped one soon.
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def publish(self, value: float, time_ns: Optional[int] = None) -> None:
        """Publishes a value, in the unit of the condition.

        `time_ns` is the time of the measurement, in ns since the Unix epoch (UTC). Without it, the
        value was measured now.

        Before the first value, waits at most 2 s until a service subscribes. Logs a warning if none
        does. Raises `ValueError` if the value is not finite, and `Closed` after `close`.
        """
        number = float(value)
        if not math.isfinite(number):
            raise ValueError(f"value is {value!r}, must be a finite number")
        with self._lock:
            if self._is_closed:
                raise Closed(f"condition {self._message['name']} is closed")
            measured_ns = time.time_ns() if time_ns is None else int(time_ns)
            self._wait_for_a_subscriber()
            self._publisher.put(
                json.dumps({**self._message, "time_ns": measured_ns, "value": number})
            )

    def close(self) -> None:
        """Withdraws the publisher. Further calls have no effect."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
        self._publisher.undeclare()
        if self._owns_session:
            self._session.close()

    def __enter__(self) -> ConditionPublisher:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()

    def _wait_for_a_subscriber(self) -> None:
        """A new session does not know the subscribers at first, and drops values without any."""
        if self._has_waited:
            return
        self._has_waited = True
        deadline = time.monotonic() + _SUBSCRIBER_TIMEOUT_S
        # The stub of zenoh states another type than the property has.
        while not getattr(self._publisher.matching_status, "matching"):
            if time.monotonic() >= deadline:
                _log.warning(
                    "no service subscribes to the condition %s; its values are lost",
                    self._message["name"],
                )
                return
            time.sleep(_LOOK_S)
