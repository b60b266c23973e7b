"""Runs `echolake design` on the targets of `examples/designs`: `design.py --program ECHOLAKE [--write FILE]`.

Flat, Foam and river rock are simulated in a lake of its own, because one target is the levels of river rock. Printed is
how far the best panel is from its target, simulated at all pairs, and what the search took. --write puts the table
between the markers in FILE. Exits with 1 if a panel is over 0.5 dB off, root mean square of its levels.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import time

TARGETS = ("waves", "bricks", "river_rock")
MOST_DB = 0.5
MARKER = "tests/numbers/design.py"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True)
    parser.add_argument("--write", type=pathlib.Path, metavar="FILE")
    args = parser.parse_args()
    designs = pathlib.Path(__file__).parents[2] / "examples" / "designs"
    lines = [
        "| target | parameters found | levels, rms, dB | in trusted bands | misfit | candidates | s each | s |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        command = [args.program, "--lake", f"{folder}/lake"]
        for surface in ("flat", "foam", "river_rock"):
            subprocess.run([*command, "acquire", "--surface", surface, "--ir-only"], check=True, capture_output=True)
        subprocess.run([*command, "ingest"], check=True, capture_output=True)
        for target in TARGETS:
            run = [*command, "design", str(designs / f"{target}.toml"), "-o", f"{folder}/{target}", "--json"]
            begun = time.monotonic()
            found = json.loads(subprocess.run(run, check=True, stdout=subprocess.PIPE, text=True).stdout)
            secs = time.monotonic() - begun
            best = found["panels"][0]
            header, first = pathlib.Path(folder, target, "candidates.csv").read_text().split("\n")[:2]
            searched = header.split(",")[1 : len(first.split(",")) - 17]
            parameters = ", ".join(f"{key} {best['relief']['parameters'][key]}" for key in searched)
            deviation, trusted = best["level_deviation_db"], best["trusted_level_deviation_db"]
            worst = max(worst, deviation)
            lines.append(
                f"| `{target}` | {parameters} | {deviation:.2f} | {'-' if trusted is None else f'{trusted:.2f}'} | "
                f"{best['misfit']:.2f} | {found['candidates']} | {found['secs_per_candidate']:.2f} | {secs:.0f} |"
            )
    print("\n".join(lines))
    if args.write:
        before, rest = args.write.read_text().split(f"<!-- {MARKER} -->\n")
        _, after = rest.split(f"<!-- end of {MARKER} -->\n")
        body = "\n".join(lines)
        args.write.write_text(f"{before}<!-- {MARKER} -->\n\n{body}\n\n<!-- end of {MARKER} -->\n{after}")
    sys.exit(worst > MOST_DB)


if __name__ == "__main__":
    main()
