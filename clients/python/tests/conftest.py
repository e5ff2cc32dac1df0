"""Fixtures of all tests."""

from __future__ import annotations

import os
import pathlib

import pytest

from services import Site


@pytest.fixture
def site(tmp_path: pathlib.Path) -> Site:
    """A site for the built program. Skips the test without the variable `PROGRAM`."""
    if "PROGRAM" not in os.environ:
        pytest.skip("the variable PROGRAM is not the path of the built program")
    return Site(tmp_path)
