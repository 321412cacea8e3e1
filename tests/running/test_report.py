"""What the report of a paced run says and shows of its schedule."""

from __future__ import annotations

import json
from pathlib import Path

from cosim.reporting.report import draw
from tests.distributed.networks import ring, scenario
from tests.distributed.test_processes import cosim, manifest


def test_report_of_a_paced_run(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), ticks=20, faults={2: ("Slow", 0.25)}))
    done = cosim(tmp_path, "net.yaml", "--out", "out", "--realtime", "2", "--overrun", "stretch")
    assert done.returncode == 0, done.stderr
    account = manifest(tmp_path / "out")["realtime"]
    page = draw(tmp_path / "out")
    assert page is not None
    text = page.read_text()
    assert "<h2>Against the wall clock</h2>" in text
    assert f"{account['missed']} of 21" in text
    assert "2 wanted" in text
    assert "stretch the schedule" in text
    assert f"max {1e3 * account['lateness_s']['max']:.3g} ms" in text
    assert '<figure class="card" id="lateness">' in text
    assert "deadline" in (tmp_path / "out" / "figures" / "lateness.svg").read_text()


def test_report_of_a_free_run_says_nothing_of_it(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3)))
    assert cosim(tmp_path, "net.yaml", "--out", "out").returncode == 0
    page = draw(tmp_path / "out")
    assert page is not None
    assert "lateness" not in page.read_text()


def test_report_of_a_paced_run_that_ended_at_once(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(1, []))
    assert cosim(tmp_path, "net.yaml", "--out", "out", "--realtime", "20").returncode == 0
    path = tmp_path / "out" / "manifest.json"
    content = manifest(tmp_path / "out")
    none = dict.fromkeys(("p50", "p99", "max"))
    content["realtime"] |= {"ticks": 0, "lateness_s": none, "jitter_s": none}
    content["realtime"]["course_s"] |= {"mean": [], "max": []}
    path.write_text(json.dumps(content))
    page = draw(tmp_path / "out")
    assert page is not None
    assert "The run ended before its second tick." in page.read_text()
