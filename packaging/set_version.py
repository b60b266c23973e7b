#!/usr/bin/env python3
"""Sets the one version of everything in a checkout and cuts the changelog: `set_version.py VERSION FOLDER`."""

from __future__ import annotations

import datetime
import re
import sys
from pathlib import Path

UNRELEASED = "## Unreleased\n"


def main() -> None:
    version, folder = sys.argv[1], Path(sys.argv[2])
    manifest = folder / "Cargo.toml"
    found = re.search(r'(?ms)^\[workspace\.package\]\nversion = "([0-9.]+)"$', manifest.read_text(encoding="utf-8"))
    old = found[1] if found else sys.exit("error: Cargo.toml: no version below [workspace.package]")
    if numbers(version) <= numbers(old):
        sys.exit(f"error: {version} is not newer than {old}")
    replace(manifest, rf'(^\[workspace\.package\]\nversion = "){old}"', version + '"', times=1)
    replace(folder / "Cargo.lock", rf'(^name = "echolake(?:-[a-z-]+)?"\nversion = "){old}"', version + '"')
    replace(folder / "web/package.json", rf'(^  "version": "){old}"', version + '"', times=1)
    replace(folder / "web/package-lock.json", rf'(^ +"name": "echolake-web",\n +"version": "){old}"', version + '"')
    replace(folder / "CITATION.cff", rf"(^version: ){old}$", version, times=1)
    cut_changelog(folder / "CHANGELOG.md", version)


def numbers(version: str) -> list[int]:
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        sys.exit(f"error: `{version}` is no version; expected three numbers, as 0.2.0")
    return [int(number) for number in version.split(".")]


def replace(file: Path, pattern: str, new: str, times: int = 0) -> None:
    text, count = re.subn(pattern, lambda found: found[1] + new, file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    if count == 0 or (times and count != times):
        sys.exit(f"error: {file.name}: {count} places have the version, expected {times or 'some'}")
    file.write_text(text, encoding="utf-8")


def cut_changelog(file: Path, version: str) -> None:
    text = file.read_text(encoding="utf-8")
    head, found, rest = text.partition(UNRELEASED)
    news = re.split(r"(?m)^## ", rest)[0].strip()
    if not found or not news:
        sys.exit(f"error: {file.name}: nothing stands below `{UNRELEASED.strip()}`; hint: a release needs news")
    today = datetime.date.today().isoformat()
    file.write_text(f"{head}{UNRELEASED}\n## {version} ({today})\n{rest}", encoding="utf-8")


if __name__ == "__main__":
    main()
