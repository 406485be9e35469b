"""docs/benchmarks.md from the figures of the last runs, one section a file in results/.

    python benchmarks/make_docs.py                    write docs/benchmarks.md
    python benchmarks/make_docs.py --keep out.json NAME   first take an output into results/

A section is a function of its JSON in `SECTIONS`. What is kept of `igaussian eval` are
the figures, not the single queries.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import render_tables
import tables

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "benchmarks.md"
# by the name of the file in results/, in the page's order
SECTIONS: dict[str, Callable[[dict[str, Any]], str]] = {
    "peers": tables.peers,
    "demo_rendered": tables.evaluation(
        "The demo room, the paper's protocol",
        "igaussian eval rendered --map room.igmap --json out.json --report report.html",
    ),
    "photos": tables.photos,
    "drive": tables.drive,
    "verdict": tables.verdict,
    "covariance": tables.covariance,
    "stage_one": tables.stage_one,
    "scale": tables.scale,
    "render": render_tables.section,
    "render_avx2": render_tables.section_of_another_machine,
}
_HEAD = """# Benchmarks

Made by `python benchmarks/make_docs.py` from `benchmarks/results/`; not edited by hand. Each
section names its command, the machine and the versions. How to read the figures:

- *Rendered* means that queries are rendered from the map itself, as in the paper; *photos* are
  real photos that the map was not trained on. The two are never mixed.
- Success: accepted, and within both thresholds. Medians run over all queries, where one without
  a pose counts as infinitely wrong; averages over accepted poses only.
- AUC: area under the recall curve while both thresholds grow together from 0.
- NEES: squared error in units of the stated covariance, 6 on average where that is true.
- Times are of two threads, wall time; on a machine with other work they vary by a third and more.
"""


def page(results: Path) -> str:
    """The whole document."""
    parts = [_HEAD]
    for name, section in SECTIONS.items():
        file = results / f"{name}.json"
        if file.is_file():
            parts.append(section(json.loads(file.read_text())))
    return "\n".join(part.rstrip() + "\n" for part in parts)


def keep(source: Path, name: str) -> None:
    """Take the output of a benchmark into results/, without single queries."""
    if name not in SECTIONS:
        raise SystemExit(f"{name}: none of {', '.join(SECTIONS)}")
    data = json.loads(source.read_text())
    for part in [data, *(row for row in data.get("photos", []) if isinstance(row, dict))]:
        part.pop("queries", None)
    for part in ("config", "answers"):
        data.pop(part, None)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(data, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", nargs=2, metavar=("JSON", "NAME"))
    options = parser.parse_args()
    if options.keep:
        keep(Path(options.keep[0]), options.keep[1])
    PAGE.write_text(page(RESULTS))
    print(PAGE)


if __name__ == "__main__":
    main()
