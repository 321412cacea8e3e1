"""Every example in the README and the docs runs, and prints what the page says it prints.

On a page, blocks run in their order in one empty folder:

- `yaml` and `python` blocks whose first line is `# file: NAME` are saved under that name; other `python` blocks run.
- `console` blocks: lines that begin with `$ ` run, the lines that follow must be printed, in that order; `...` stands
  for anything. A command may end in `# exit N`. One that ends in `&` runs beside those that follow in its block.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "fmus").rglob("README.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"# file: (\S+)\n")


def examples(page: Path) -> list[tuple[str, str]]:
    """Language and text of the blocks that this test runs."""
    return [(kind, text) for kind, text in BLOCK.findall(page.read_text()) if kind in ("yaml", "python", "console")]


def commands(text: str) -> Iterator[tuple[str, int, list[str]]]:
    """(command, exit code, expected lines) of a console block."""
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        first, *expected = part.rstrip("\n").split("\n")
        command, _, code = first.partition("  # exit ")
        yield command, int(code or 0), expected


def assert_prints(output: str, expected: list[str]) -> None:
    """The expected lines occur in the output in this order."""
    rest = output.splitlines()
    for line in expected:
        if line.strip() == "...":
            continue
        pattern = re.compile(".*".join(re.escape(piece) for piece in line.rstrip().split("...")))
        found = next((i for i, candidate in enumerate(rest) if pattern.fullmatch(candidate.rstrip())), None)
        assert found is not None, f"not printed: {line!r}\nthe output was:\n{output}"
        rest = rest[found + 1 :]


@pytest.mark.parametrize(
    "page", [page for page in PAGES if examples(page)], ids=lambda page: page.relative_to(ROOT).as_posix()
)
def test_page(page: Path, tmp_path: Path) -> None:
    environment = dict(os.environ, PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    environment["PYTHONPATH"] = str(tmp_path)

    def run(command: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command, cwd=tmp_path, env=environment, text=True, capture_output=True, timeout=120, check=False
        )

    for kind, text in examples(page):
        if named := FILE.match(text):
            (tmp_path / named[1]).write_text(text)
        elif kind == "python":
            done = run([sys.executable, "-c", text])
            assert done.returncode == 0, f"{text}\n{done.stderr}"
        elif kind == "console":
            with ThreadPoolExecutor(max_workers=8) as beside:
                runs = []
                for command, code, expected in commands(text):
                    running = beside.submit(run, shlex.split(command.removesuffix(" &")))
                    runs.append((command, code, expected, running))
                    if not command.endswith(" &"):
                        running.result()
            for command, code, expected, running in runs:
                done = running.result()
                assert done.returncode == code, f"$ {command}\n{done.stdout}{done.stderr}"
                assert_prints(done.stdout + done.stderr, expected)
