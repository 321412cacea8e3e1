"""Starting, and ending, the process of an isolated component."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import suppress

from cosim.components.isolation.calls import Channel
from cosim.logs import Sink
from cosim.native_output import Pump
from cosim.scratch import Scratch
from cosim.spawning import how_it_ended, kill_group, search_path

_EXIT_SECONDS = 2.0
_GONE_SECONDS = 10.0
"""For a process whose connection is closed already: all that can take long is writing a core dump."""

_TAIL_LINES = 5
_TAIL_BYTES = 10_000


class HostProcess:
    """A process for one component. It ends with the one that started it, whatever becomes of that.

    Args:
        log: takes what is printed and logged there.

    Raises:
        OSError: the system refuses.
    """

    def __init__(self, log: Sink) -> None:
        self._log = log
        self._tail = bytearray()
        self._scratch = Scratch()
        own, others = socket.socketpair()
        reading, writing = os.pipe()
        command = [sys.executable, "-P", "-m", "cosim.components.isolation.host", str(others.fileno())]
        try:
            with others:
                self._process = subprocess.Popen(  # noqa: S603
                    [*command, str(self._scratch.path)],
                    env={**os.environ, "PYTHONPATH": search_path()},
                    stdin=subprocess.PIPE,
                    stdout=writing,
                    stderr=subprocess.STDOUT,
                    pass_fds=[others.fileno()],
                    start_new_session=True,
                )
        except OSError:
            own.close()
            os.close(reading)
            self._scratch.remove()
            raise
        finally:
            os.close(writing)
        self._pump = Pump(reading, self._take)
        self.channel = Channel(own)

    @property
    def last_lines(self) -> str | None:
        """The last that was printed or logged."""
        lines = self._tail.decode(errors="replace").splitlines()[-_TAIL_LINES:]
        return "\n".join(lines) or None

    def ended(self) -> str | None:
        """How it ended, if it has, or does so at once."""
        with suppress(subprocess.TimeoutExpired):
            return how_it_ended(self._process.wait(_GONE_SECONDS))
        return None

    def end(self) -> None:
        """End it, with all that it has started, and remove what it left."""
        self.channel.close()
        if self._process.stdin is not None:
            self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_SECONDS)
        self.kill()

    def kill(self) -> None:
        """End it at once."""
        kill_group(self._process, "the process of a component")
        if self._process.stdin is not None:
            self._process.stdin.close()
        self.channel.close()
        self._pump.drain()
        self._scratch.remove()

    def _take(self, data: bytes) -> None:
        self._log(data)
        self._tail += data[-_TAIL_BYTES:]
        del self._tail[:-_TAIL_BYTES]
