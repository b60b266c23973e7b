#!/usr/bin/env python3
"""Lists what is inside a build: the crates that are compiled in and the npm packages of the catalogue's pages.

`inventory.py licences SOURCE TARGET...` writes `THIRD-PARTY-LICENCES.txt` and `pages.cdx.json` to SOURCE/python, where
maturin finds them. `inventory.py merge WHEEL OUTPUT` makes one CycloneDX file of the two that are in a wheel.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

LICENCE_FILE = re.compile(r"(licen[cs]e|copying|notice|copyright|unlicense|patents)", re.IGNORECASE)
NO_TEXT = re.compile(r"\.(rs|c|h|cc|py|pl|go|toml|json|ya?ml|html|hpp|cmake|in|sh|js|ts)$", re.IGNORECASE)
LINE = "=" * 100


@dataclass(order=True)
class Component:
    """A package that is part of the program."""

    name: str
    version: str
    licence: str
    origin: str
    texts: list[str] = field(default_factory=list, compare=False)


def main() -> None:
    match sys.argv[1:]:
        case ["licences", source, *targets] if targets:
            write_licences(Path(source), targets)
        case ["merge", wheel, output]:
            merge_inventories(Path(wheel), Path(output))
        case _:
            sys.exit(__doc__)


def write_licences(source: Path, targets: list[str]) -> None:
    pages = page_components(source)
    own = [*toolchain_components(targets), figure_font(source)]
    components = sorted(crate_components(source, targets) + pages + own)
    python = source / "python"
    (python / "THIRD-PARTY-LICENCES.txt").write_text(licence_text(components), encoding="utf-8")
    (python / "pages.cdx.json").write_text(json.dumps(page_inventory(pages), indent=1) + "\n", encoding="utf-8")
    silent = [f"{c.name} {c.version} ({c.licence})" for c in components if not c.texts]
    print(f"{len(components)} packages; without any licence text: {', '.join(silent) or 'none'}", file=sys.stderr)


def output_of(*command: str, folder: Path) -> str:
    return subprocess.run(command, cwd=folder, check=True, text=True, stdout=subprocess.PIPE).stdout


def crate_components(source: Path, targets: list[str]) -> list[Component]:
    """Crates that a target's program contains; procedural macros and build scripts are not part of it."""
    inside: set[tuple[str, str]] = set()
    for target in targets:
        listed = output_of(
            "cargo",
            "tree",
            "--locked",
            "-p",
            "echolake",
            "-e",
            "normal,no-proc-macro",
            "--target",
            target,
            "--prefix",
            "none",
            "--format",
            "{p}",
            folder=source,
        )
        inside |= {
            (name, version.lstrip("v")) for name, version, *_ in map(str.split, filter(None, listed.splitlines()))
        }
    standard = standard_texts(source)
    metadata = json.loads(output_of("cargo", "metadata", "--locked", "--format-version", "1", folder=source))
    return [
        Component(
            name=package["name"],
            version=package["version"],
            licence=(package["license"] or f"see {package['license_file']}").replace("/", " OR ").replace("  ", " "),
            origin=f"https://crates.io/crates/{package['name']}",
            texts=licence_files(Path(package["manifest_path"]).parent)
            or [copyright_line(package) + text for name, text in standard.items() if package["license"] == name],
        )
        for package in metadata["packages"]
        if (package["name"], package["version"]) in inside and package["source"] is not None
    ]


def standard_texts(source: Path) -> dict[str, str]:
    """For packages that name a licence and carry no text of it."""
    mit = (source / "LICENSE-MIT").read_text(encoding="utf-8")
    return {
        "MIT": "MIT License\n\n" + mit[mit.index("Permission is hereby granted") :].strip(),
        "Apache-2.0": (source / "LICENSE-APACHE").read_text(encoding="utf-8").strip(),
    }


def copyright_line(package: dict[str, list[str]]) -> str:
    return f"Copyright {', '.join(package['authors']) or 'the authors of ' + str(package['name'])}\n\n"


def licence_files(folder: Path) -> list[str]:
    """All licences in a package's sources: those of C code that it brings along stand deeper in it."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and is_licence(path))
    return [path.read_text(encoding="utf-8", errors="replace").strip() for path in found]


def is_licence(path: Path) -> bool:
    return bool(LICENCE_FILE.match(path.name)) and not NO_TEXT.search(path.name) and path.stat().st_size < 200_000


def page_components(source: Path) -> list[Component]:
    listed = json.loads((source / "web/prebuilt/licences.json").read_text(encoding="utf-8"))
    return [
        Component(
            name=entry["name"],
            version=entry["version"],
            licence=entry["identifier"],
            origin=f"https://www.npmjs.com/package/{entry['name']}",
            texts=[entry["text"].strip()],
        )
        for entry in listed
    ]


def toolchain_components(targets: list[str]) -> list[Component]:
    """What the compiler links into every program: Rust's standard library, and musl where it is static."""
    rustc = dict(
        line.split(": ", 1) for line in output_of("rustc", "-vV", folder=Path(".")).splitlines() if ": " in line
    )
    documents = Path(output_of("rustc", "--print", "sysroot", folder=Path(".")).strip()) / "share/doc/rust"
    texts = [path.read_text(encoding="utf-8").strip() for path in sorted(documents.glob("licenses/[AM][pI]*.txt"))]
    std = Component("Rust standard library", rustc["release"], "MIT OR Apache-2.0", "https://www.rust-lang.org", texts)
    if not any("musl" in target for target in targets):
        return [std]
    copyrights = [Path(folder) / "ziglang/lib/libc/musl/COPYRIGHT" for folder in sys.path]
    texts = [path.read_text(encoding="utf-8").strip() for path in copyrights if path.is_file()][:1]
    return [std, Component("musl", "1.2 (programs for musl only)", "MIT", "https://musl.libc.org", texts)]


def figure_font(source: Path) -> Component:
    """The font inside figures: a Latin part of IBM Plex Sans under another name."""
    text = (source / "figures/src/canvas/font/OFL.txt").read_text(encoding="utf-8").strip()
    return Component("IBM Plex Sans, Latin, without hints", "3.201", "OFL-1.1", "https://github.com/IBM/plex", [text])


def licence_text(components: list[Component]) -> str:
    numbers: dict[str, int] = {}
    texts: list[str] = []
    users: list[list[str]] = []
    rows = []
    for component in components:
        used = []
        for text in component.texts:
            number = numbers.setdefault(" ".join(text.split()), len(texts))
            if number == len(texts):
                texts.append(text)
                users.append([])
            if component.name not in users[number]:
                users[number].append(component.name)
            used.append(f"[{number + 1}]")
        rows.append(f"{component.name} {component.version}\n    {component.licence}\n    {component.origin}")
        rows.append(f"    texts: {' '.join(dict.fromkeys(used)) or 'none in the package'}")
    out = [
        "echolake itself is licensed under Apache-2.0 or MIT, at your choice. It contains the following packages.",
        "",
    ]
    out += [*rows, ""]
    for number, (text, names) in enumerate(zip(texts, users, strict=True), start=1):
        out += [LINE, f"[{number}] {', '.join(names)}", LINE, "", text, ""]
    return "\n".join(out)


def page_inventory(pages: list[Component]) -> dict[str, object]:
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "application", "name": "echolake-web", "bom-ref": "echolake-web"}},
        "components": [
            {
                "type": "library",
                "bom-ref": (purl := f"pkg:npm/{quote(page.name, safe='/')}@{page.version}"),
                "name": page.name,
                "version": page.version,
                "scope": "required",
                "licenses": [{"expression": page.licence}],
                "purl": purl,
            }
            for page in pages
        ],
    }


def merge_inventories(wheel: Path, output: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = sorted(name for name in archive.namelist() if "/sboms/" in name)
        crates, pages = (json.loads(archive.read(name)) for name in names)
    crates["components"] += pages["components"]
    output.write_text(json.dumps(crates, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
