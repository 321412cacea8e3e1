"""A run across processes: the same agents, emulator and master as in-process, in processes of their own.

The orchestrator drives the clock and records; one process emulates the network; worker processes carry the agents.
`worker`, `emulation` and `orchestration` are pure state machines: envelopes in, messages out. `serving` and
`supervision` are the loops around them that know deadlines and an `Endpoint`; `processes` starts them, `cluster` joins
all. `replay` and `replacement` are what it takes to replace a lost worker; `survey` and `standing` find out who waits
for whom. Where people start the processes by hand, `hosting` is the orchestrator's side and `joining` that of the
others; `lobby` decides who may come, `files` brings FMUs to where they are needed, `connecting` is where they meet.
"""
