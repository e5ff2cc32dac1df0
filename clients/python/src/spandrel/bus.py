"""Names, keys and sessions of the Zenoh bus."""

from __future__ import annotations

import json
import pathlib
import re
from typing import Optional, Tuple, Union

import zenoh

from .errors import InvalidName, NotConnected

#: Endpoint of `spandrel run` and `spandrel demo` on the same machine.
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
#: First chunk of all keys, unless `bus.root` is set.
DEFAULT_ROOT = "spandrel"
#: Time to wait for a connection, in seconds.
DEFAULT_TIMEOUT_S = 10.0

#: An endpoint such as `tcp/127.0.0.1:7447`, or an open session to share.
Connect = Union[str, zenoh.Session]
#: Path of a certificate `ROLE.NAME.pem`.
Certificate = Union[str, "pathlib.PurePath"]

_NAME = re.compile(r"[a-z0-9-]{1,64}")


def check_name(what: str, name: str) -> str:
    """Returns a name, or raises `InvalidName` if keys do not allow it."""
    if not _NAME.fullmatch(name):
        raise InvalidName(f"{what} is {name!r}, must have 1 to 64 characters of a-z, 0-9 and -")
    return name


def key(root: str, structure: str, rest: str) -> str:
    """Returns a key of a structure. Checks the names of the root and the structure."""
    return f"{check_name('root', root)}/{check_name('structure', structure)}/{rest}"


def open_session(
    connect: Connect = DEFAULT_ENDPOINT,
    certificate: Optional[Certificate] = None,
    timeout: float = DEFAULT_TIMEOUT_S,
) -> zenoh.Session:
    """Opens a Zenoh session to `connect`, which several sensors and subscriptions can share.

    The key of the certificate and `authority.pem` must be in the folder of the certificate.
    Raises `NotConnected` if there is no connection after `timeout` seconds.
    """
    return _session(connect, certificate, timeout)[0]


def owned_or_shared(
    connect: Connect, certificate: Optional[Certificate], timeout: float
) -> Tuple[zenoh.Session, bool]:
    """Returns a session, and whether the caller must close it."""
    return _session(connect, certificate, timeout)


def _session(
    connect: Connect, certificate: Optional[Certificate], timeout: float
) -> Tuple[zenoh.Session, bool]:
    if not isinstance(connect, str):
        return connect, False
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [connect],
        # Without these settings, Zenoh retries silently and permanently.
        "connect/timeout_ms": max(1, round(timeout * 1000)),
        "connect/exit_on_failure": True,
    }
    if certificate is not None:
        pem = pathlib.Path(certificate)
        files = {
            "root_ca_certificate": pem.with_name("authority.pem"),
            "connect_certificate": pem,
            "connect_private_key": pem.with_suffix(".key"),
        }
        for path in files.values():
            if not path.is_file():
                raise NotConnected(f"{path} does not exist; {pem.name} needs it in the same folder")
        settings.update({f"transport/link/tls/{name}": str(path) for name, path in files.items()})
        settings["transport/link/tls/enable_mtls"] = True
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config), True
    except zenoh.ZError as error:
        raise NotConnected(
            f"no connection to {connect} within {timeout:g} s; start spandrel run or a router there, "
            "or pass its endpoint as connect. spandrel watch with the same endpoint and certificate "
            f"names the cause. Zenoh reports: {error}"
        ) from error
