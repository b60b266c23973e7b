"""A lake that the command makes and serves, and what it exports. ``ECHOLAKE`` names the command's binary; where it is
missing, what needs it is skipped."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

#: How long a command may take; a busy machine may need some of it.
LIMIT_SECS = 1800


@pytest.fixture(scope="session")
def echolake() -> str:
    found = os.environ.get("ECHOLAKE") or shutil.which("echolake")
    if not found:
        pytest.skip("no echolake binary; hint: ECHOLAKE=target/quick/echolake")
    return found


@pytest.fixture(scope="session")
def lake(echolake: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve surfaces; ``ECHOLAKE_TEST_LAKE`` names one that is there already."""
    if there := os.environ.get("ECHOLAKE_TEST_LAKE"):
        return Path(there)
    path = tmp_path_factory.mktemp("lake") / "lake"
    subprocess.run(
        [echolake, "--lake", str(path), "demo", "--no-serve", "--surfaces", "12", "--ir-only"],
        check=True,
        capture_output=True,
        timeout=LIMIT_SECS,
    )
    return path


@pytest.fixture(scope="session")
def addresses(echolake: str, lake: Path) -> Iterator[dict[str, str]]:
    """Where it is served, by scheme."""
    anywhere = "127.0.0.1:0"
    command = [
        echolake,
        "--lake",
        str(lake),
        "serve",
        "--listen",
        anywhere,
        "--flight-sql",
        anywhere,
        "--postgres",
        "off",
    ]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    # Reading its lines has no limit of its own: a server that says nothing is killed, and they end.
    silence = threading.Timer(LIMIT_SECS, server.kill)
    silence.start()
    try:
        assert server.stderr is not None
        found: dict[str, str] = {}
        for line in server.stderr:
            found |= {scheme: f"{scheme}://{host}" for scheme, host in re.findall(r"(http|grpc)://(\S+:\d+)", line)}
            if len(found) == 2:
                break
        else:
            pytest.fail("the server ended before it listened")
        silence.cancel()
        # What it says later must not fill the pipe.
        threading.Thread(target=server.stderr.read, daemon=True).start()
        yield found
    finally:
        silence.cancel()
        server.terminate()
        try:
            server.wait(timeout=60)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait(timeout=60)
            raise


@pytest.fixture(scope="session")
def served(addresses: dict[str, str]) -> str:
    """Its Flight SQL address."""
    return addresses["grpc"]


@pytest.fixture(scope="session")
def served_http(addresses: dict[str, str]) -> str:
    """Its HTTP address."""
    return addresses["http"]


def export(echolake: str, lake: Path, *arguments: str) -> None:
    command = [echolake, "--lake", str(lake), "export", *arguments]
    subprocess.run(command, check=True, capture_output=True, timeout=LIMIT_SECS)


@pytest.fixture(scope="session")
def training_set(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rows as measured."""
    path = tmp_path_factory.mktemp("ml") / "plain"
    export(echolake, lake, "ml", "-o", str(path))
    return path


@pytest.fixture(scope="session")
def turned_set(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rows under all symmetries, few columns."""
    path = tmp_path_factory.mktemp("ml") / "turned"
    export(echolake, lake, "ml", "-o", str(path), "--symmetries", "all", "--columns", "tnce_total")
    return path


@pytest.fixture(scope="session")
def a_slice(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five measurements of one run."""
    path = tmp_path_factory.mktemp("slices") / "five.mcap"
    export(echolake, lake, "mcap", "--where", "surface_id = 'flat' and pair_id < 5", "-o", str(path))
    return path
