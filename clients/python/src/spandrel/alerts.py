"""Latest alerts, and their acknowledgement."""

from __future__ import annotations

import json
import queue
import time
from typing import List, Optional, Union

import zenoh

from .bus import DEFAULT_ENDPOINT, DEFAULT_ROOT, DEFAULT_TIMEOUT_S, Certificate, Connect
from .bus import check_name, key, owned_or_shared
from .errors import NoReply, SpandrelError
from .messages import Alert, decode

#: Encoding of an acknowledgement.
ENCODING = "application/json;spandrel.acknowledgement.v1"
#: Time between two looks for a subscriber of the acknowledgement, in seconds.
_LOOK_S = 0.05


def latest_alerts(
    structure: str,
    connect: Connect = DEFAULT_ENDPOINT,
    certificate: Optional[Certificate] = None,
    root: str = DEFAULT_ROOT,
    *,
    timeout: float = DEFAULT_TIMEOUT_S,
) -> List[Alert]:
    """Returns the latest alert of each parameter, in the order of the names.

    The list is empty before the first decision, and if the structure has no alert rule or no alert
    service.
    """
    session, is_owned = owned_or_shared(connect, certificate, timeout)
    try:
        found = []
        replies = session.get(
            key(root, structure, "alert/*"),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        for reply in replies:
            if reply.ok is not None:
                found.append(_alert(reply.ok))
    finally:
        if is_owned:
            session.close()
    return sorted(found, key=lambda alert: alert.parameter)


def acknowledge(
    structure: str,
    parameter: str,
    who: str,
    note: str = "",
    connect: Connect = DEFAULT_ENDPOINT,
    certificate: Optional[Certificate] = None,
    root: str = DEFAULT_ROOT,
    *,
    timeout: float = DEFAULT_TIMEOUT_S,
) -> Alert:
    """Acknowledges the alert of a parameter, and returns the acknowledged alert.

    At an endpoint `quic/...`, the certificate must be that of an operator. Raises `NoReply` if the
    alert service does not confirm within `timeout` seconds. The reason can be that there is no
    raised alert, or that the certificate does not permit acknowledgements.
    """
    check_name("parameter", parameter)
    topic = key(root, structure, f"alert/{parameter}")
    session, is_owned = owned_or_shared(connect, certificate, timeout)
    try:
        changes: "queue.Queue[Union[Alert, SpandrelError]]" = queue.Queue()

        def receive(sample: zenoh.Sample) -> None:
            try:
                changes.put(_alert(sample))
            except SpandrelError as error:
                changes.put(error)

        deadline = time.monotonic() + timeout
        confirmations = session.declare_subscriber(topic, receive)
        publisher = session.declare_publisher(
            f"{topic}/acknowledge",
            encoding=ENCODING,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        # A new session does not know the subscriber of the alert service at first.
        # The stub of zenoh states another type than the property has.
        while not getattr(publisher.matching_status, "matching") and time.monotonic() < deadline:
            time.sleep(_LOOK_S)
        message = {
            "structure": structure,
            "parameter": parameter,
            "time_ns": time.time_ns(),
            "who": who,
            "note": note,
        }
        publisher.put(json.dumps(message))
        while True:
            try:
                change = changes.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise NoReply(
                    f"the alert service did not acknowledge the alert of {structure}/{parameter} within "
                    f"{timeout:g} s; is there a raised alert, and may this certificate acknowledge it?"
                ) from None
            if isinstance(change, SpandrelError):
                raise change
            if change.state == "acknowledged":
                confirmations.undeclare()
                return change
    finally:
        if is_owned:
            session.close()


def _alert(sample: zenoh.Sample) -> Alert:
    return decode(Alert, str(sample.key_expr), str(sample.encoding), sample.payload.to_bytes())
