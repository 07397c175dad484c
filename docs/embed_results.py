"""Copy results of runs into ``docs/results`` and the tables there into the README, so that no number is typed by hand.

``python docs/embed_results.py RUN_FOLDER NAME`` takes the table, the figures and the first animation of a finished run or sweep, and of a table 1 what its
finished runs are known by and were evaluated to, from which ``python -m gpe_pl.tables docs/results/NAME`` makes the table again.
``python docs/embed_results.py`` only renews the README; ``--check`` fails if the README differs from ``docs/results``.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
README = DOCS.parent / "README.md"
BLOCK = re.compile(r"(<!-- begin (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
FILES = (
    *("table.md", "table.csv", "metrics.csv", "config.json", "results.json"),
    *("table1.md", "table1_ratios.md", "table1.csv", "table1.png", "error_by_parameter.png", "step_times.json"),
    *("trials.md", "trials.csv"),
    *("validation_loss.png", "error_curve_*.png", "rollout_test_*.png", "rollout_test_00.gif", "stress_*_00.png"),
    *("long_horizon_*.png", "perturbation_*.png", "scaling.png", "cost_error_*.png"),
    *("showcase.json", "showcase.md", "showcase.png"),
)


def embedded(text: str) -> str:
    """The text with every marked block replaced by the file that it names."""
    return BLOCK.sub(lambda m: m[1] + (DOCS.parent / m[2]).read_text().rstrip() + "\n" + m[3], text)


def collect(run: Path, name: str) -> None:
    """Copy what is worth citing of a run into ``docs/results/{name}``."""
    target = DOCS / "results" / name
    target.mkdir(parents=True, exist_ok=True)
    is_table1 = (run / "table1.csv").exists()
    for pattern in FILES:
        for path in sorted(run.glob(pattern)):
            if not (is_table1 and path.stem == "table"):  # of all its runs at once, which says nothing
                shutil.copy(path, target / path.name)
    if is_table1:  # takes many hours; its rules may change
        for metrics in sorted(run.glob("*/**/metrics.csv")):
            if (metrics.parent / "config.json").exists():
                kept = target / "runs" / metrics.parent.relative_to(run)
                kept.mkdir(parents=True, exist_ok=True)
                for file in metrics.parent.glob("metrics.csv*"):  # with its digest
                    shutil.copy(file, kept)
                shutil.copy(metrics.parent / "config.json", kept)
        for picture in sorted(run.glob("data=*/model=gpe_tuned/seed=0/rollout_test_unseen_00.png")):
            shutil.copy(picture, target / f"rollout_{picture.parts[-4].removeprefix('data=')}.png")


def main(arguments: list[str]) -> int:
    """Collect, embed or check; the exit status."""
    if arguments == ["--check"]:
        return int(embedded(README.read_text()) != README.read_text())
    if arguments:
        collect(Path(arguments[0]), arguments[1])
    README.write_text(embedded(README.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
