"""Errors of this package."""

from __future__ import annotations


class SpandrelError(Exception):
    """Base class of all errors of this package."""


class InvalidName(SpandrelError, ValueError):
    """The name of a structure, node or parameter is not allowed in a key."""


class InvalidSamples(SpandrelError, ValueError):
    """Samples do not have the shape of the node, or are not numbers."""


class NotConnected(SpandrelError, ConnectionError):
    """No program replies at the endpoint, or it rejects the certificate."""


class Closed(SpandrelError):
    """The sensor or subscription has been closed."""


class InvalidMessage(SpandrelError):
    """A received message cannot be read."""


class UnsupportedVersion(InvalidMessage):
    """A received message has another type or version than this package supports."""


class NoReply(SpandrelError, TimeoutError):
    """No service replied to a query or confirmed a message in time."""


class QueryRejected(SpandrelError):
    """A service rejected a query. The text is the reason that the service states."""
