"""Fixtures for the clients' own tests: they talk to each other before anything of ours talks to them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def start(name, *args):
    """Starts a client; its first line on stderr says that its sockets are open."""
    return subprocess.Popen(
        [sys.executable, HERE / f"{name}.py", *map(str, args)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ready(process):
    line = process.stderr.readline()
    assert line.startswith("ready "), line + process.stderr.read()
    return json.loads(line.removeprefix("ready "))


def finish(process, rc=0):
    out, err = process.communicate(timeout=60)
    assert process.returncode == rc, err + out
    return json.loads(out)


def run(name, *args, rc=0):
    return finish(start(name, *args), rc)


@pytest.fixture
def shared():
    """The folder of data sets that do not ship with the project."""
    default = HERE.parent.parent.parent / "shared"
    folder = Path(os.environ.get("EMBERFIX_SHARED", default)) / "data"
    if not folder.is_dir():
        pytest.skip(f"no data sets at {folder}")
    return folder
