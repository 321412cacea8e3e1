"""Which worker carries which agents, where the scenario says so."""

from __future__ import annotations

from cosim.errors import suggest
from cosim.plan import Workers
from cosim.planning.problems import Problems
from cosim.scenario.names import agent_names, in_short
from cosim.scenario.reading import Scenario


def plan_workers(scenario: Scenario, problems: Problems) -> Workers:
    """`workers:` with indices for names: every agent has one worker."""
    wanted = scenario.spec.workers
    if not isinstance(wanted, dict):
        return wanted
    index_of = {name: index for index, name in enumerate(scenario.agents)}
    carrier: dict[str, str] = {}
    for worker, text in wanted.items():
        where = scenario.root.locate("workers", worker)
        for name in agent_names(text):
            if name not in index_of:
                if not scenario.doubts.about_agent(name):
                    problems.error(f"unknown agent {name!r}{suggest(name, index_of)}", where)
            elif name in carrier:
                other = "this worker" if carrier[name] == worker else repr(carrier[name])
                problems.error(f"agent {name!r} is carried by {other} already", where)
            else:
                carrier[name] = worker
    missing = [name for name in index_of if name not in carrier]
    if missing and scenario.doubts.all_agents_known:
        problems.error(
            f"no worker carries agent{'' if len(missing) == 1 else 's'} {in_short(missing)}",
            scenario.root.locate("workers", key=True),
        )
    return {
        worker: tuple(sorted(index_of[name] for name, carried_by in carrier.items() if carried_by == worker))
        for worker in wanted
    }
