"""The package itself: types, installation and the oldest Python version."""

from __future__ import annotations

import pathlib
import subprocess
import sys
import textwrap

import pytest

from services import REPOSITORY

FOLDER = REPOSITORY / "clients" / "python"


def run(command, **settings):
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **settings
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


def test_the_types_are_complete():
    pytest.importorskip("mypy")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--config-file",
        "pyproject.toml",
        "--cache-dir",
        "/dev/null",
    ]
    assert "no issues found" in run([*command, "src"], cwd=FOLDER)


def test_the_installed_package_has_its_modules_and_types(tmp_path):
    """Installs without a package index: the build backend comes from this environment."""
    pytest.importorskip("setuptools")
    source = tmp_path / "source"
    # A build writes files beside its sources.
    run(["cp", "-r", str(FOLDER), str(source)])
    run(["rm", "-rf", str(source / "build")])
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    target = tmp_path / "installed"
    run([*install, "--target", str(target), str(source)])
    expected = {path.relative_to(FOLDER / "src") for path in (FOLDER / "src").rglob("*.py")}
    expected.add(pathlib.Path("spandrel/py.typed"))
    found = {path.relative_to(target) for path in target.rglob("spandrel/*") if path.is_file()}
    assert expected == found
    script = "import spandrel; print(spandrel.__file__)"
    said = run([sys.executable, "-c", script], env={"PYTHONPATH": str(target)})
    assert str(target) in said


@pytest.mark.parametrize(
    ("page", "begin", "modules"),
    [
        ("clients/python/README.md", "```sh install\n", "matplotlib, spandrel"),
        ("docs/how-to.md", "   ```sh\n   python3 -m venv", "spandrel"),
    ],
)
def test_the_install_commands_of_the_pages_work_as_printed(tmp_path, page, begin, modules):
    """Needs the package index, and is skipped without it."""
    text = (REPOSITORY / page).read_text()
    start = text.index(begin) + begin.index("\n") + 1
    script = textwrap.dedent(text[start : text.index("```", start)])
    assert "pip install" in script
    index = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--dest",
        str(tmp_path),
    ]
    reached = subprocess.run(
        [*index, "mypy_extensions"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    if reached.returncode != 0:
        pytest.skip("the package index cannot be reached")
    (tmp_path / "clients").mkdir()
    run(["cp", "-r", str(FOLDER), str(tmp_path / "clients" / "python")])
    run(["bash", "-euo", "pipefail", "-c", script], cwd=tmp_path)
    python = tmp_path / "spandrel-python" / "bin" / "python"
    asks = f"import {modules}; print(spandrel.Sensor.__name__, spandrel.__file__)"
    assert "site-packages" in run([str(python), "-c", asks])
