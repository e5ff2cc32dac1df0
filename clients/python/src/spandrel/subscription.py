"""Subscriptions to display messages."""

from __future__ import annotations

import collections
import logging
import threading
from types import TracebackType
from typing import Any, Callable, Deque, Iterator, List, Optional, Sequence, Type, Union

import zenoh

from .bus import DEFAULT_ENDPOINT, DEFAULT_ROOT, DEFAULT_TIMEOUT_S, Certificate, Connect
from .bus import check_name, owned_or_shared
from .errors import Closed, SpandrelError
from .messages import MESSAGES, Message, decode

_log = logging.getLogger("spandrel")

#: Maximum number of messages that wait for the iterator.
QUEUE = 10_000


def subscribe(
    structure: str,
    kinds: Sequence[Type[Any]] = MESSAGES,
    callback: Optional[Callable[[Message], None]] = None,
    connect: Connect = DEFAULT_ENDPOINT,
    certificate: Optional[Certificate] = None,
    root: str = DEFAULT_ROOT,
    *,
    on_error: Optional[Callable[[SpandrelError], None]] = None,
    queue: int = QUEUE,
    timeout: float = DEFAULT_TIMEOUT_S,
) -> Subscription:
    """Subscribes to the display messages of a structure, or of all structures with `"*"`.

    `kinds` contains the types of messages, such as `[Parameter, Alert]`. The default is all types.

    Without `callback`, iterate over the result. A message that cannot be read is raised as an
    error, such as `UnsupportedVersion`. The iteration can continue after the error. At most `queue`
    messages wait. If the queue is full, the oldest message is dropped, counted in
    `Subscription.dropped` and reported in the log.

    With `callback`, a thread of Zenoh calls it with each message. Errors go to `on_error`, or to
    the log without it.

        with subscribe("demo", [Parameter, Alert]) as messages:
            for message in messages:
                print(message)

    Raises `NotConnected` if no program replies at `connect` within `timeout` seconds.
    """
    return Subscription(
        structure, kinds, callback, connect, certificate, root, on_error, queue, timeout
    )


class Subscription:
    """Display messages of a structure. Created by `subscribe`."""

    def __init__(
        self,
        structure: str,
        kinds: Sequence[Type[Any]],
        callback: Optional[Callable[[Message], None]],
        connect: Connect,
        certificate: Optional[Certificate],
        root: str,
        on_error: Optional[Callable[[SpandrelError], None]],
        queue: int,
        timeout: float,
    ) -> None:
        if structure != "*":
            check_name("structure", structure)
        for kind in kinds:
            if kind not in MESSAGES:
                raise ValueError(f"{kind!r} is not a type of display messages")
        if queue < 1:
            raise ValueError(f"queue is {queue}, must be at least 1")
        self._prefix = f"{check_name('root', root)}/{structure}/"
        self._callback = callback
        self._on_error = on_error
        self._queue: Deque[Union[Message, SpandrelError]] = collections.deque()
        self._most = queue
        self._dropped = 0
        self._changed = threading.Condition()
        self._is_closed = False
        self._session, self._owns_session = owned_or_shared(connect, certificate, timeout)
        self._subscribers: List[zenoh.Subscriber[None]] = []
        for kind in kinds:
            self._subscribers.append(self._declare(kind))

    def _declare(self, kind: Type[Any]) -> zenoh.Subscriber[None]:
        chunks = [name if "{" not in name else "*" for name in kind.KEY.split("/")]

        def receive(sample: zenoh.Sample) -> None:
            self._receive(kind, sample)

        return self._session.declare_subscriber(self._prefix + "/".join(chunks), receive)

    @property
    def dropped(self) -> int:
        """The number of messages dropped because the queue was full."""
        return self._dropped

    def receive(self, timeout: Optional[float] = None) -> Optional[Message]:
        """Waits for the next message. Returns `None` after `timeout` seconds.

        Raises the error of a message that cannot be read, and `Closed` after `close`.
        """
        if self._callback is not None:
            raise ValueError("the callback receives the messages of this subscription")
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._is_closed, timeout)
            if not self._queue:
                if self._is_closed:
                    raise Closed("the subscription is closed")
                return None
            item = self._queue.popleft()
        if isinstance(item, SpandrelError):
            raise item
        return item

    def __iter__(self) -> Iterator[Message]:
        return self

    def __next__(self) -> Message:
        try:
            message = self.receive()
        except Closed:
            raise StopIteration from None
        assert message is not None  # without a timeout
        return message

    def close(self) -> None:
        """Ends the subscription. An iteration ends after the waiting messages."""
        with self._changed:
            if self._is_closed:
                return
            self._is_closed = True
            self._changed.notify_all()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        if self._owns_session:
            self._session.close()

    def __enter__(self) -> Subscription:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()

    def _receive(self, kind: Type[Any], sample: zenoh.Sample) -> None:
        """Decodes a message, on a thread of Zenoh."""
        item: Union[Message, SpandrelError]
        try:
            key, encoding = str(sample.key_expr), str(sample.encoding)
            item = decode(kind, key, encoding, sample.payload.to_bytes())
        except SpandrelError as error:
            item = error
        if self._callback is None:
            self._enqueue(item)
        elif not isinstance(item, SpandrelError):
            try:
                self._callback(item)
            except Exception:  # of the caller; the next message is independent of it
                _log.exception("the callback of a subscription failed")
        elif self._on_error is not None:
            self._on_error(item)
        else:
            _log.error("message rejected: %s", item)

    def _enqueue(self, item: Union[Message, SpandrelError]) -> None:
        with self._changed:
            if self._is_closed:
                return
            if len(self._queue) >= self._most:
                self._queue.popleft()
                self._dropped += 1
                if self._dropped & (self._dropped - 1) == 0:  # each time the count has doubled
                    _log.warning("%d messages dropped because the queue was full", self._dropped)
            self._queue.append(item)
            self._changed.notify()
