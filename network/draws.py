"""Counter-based random draws: every number is a pure function of what it is for, never of what was drawn before it.

A draw is keyed by (seed, sender's name, receiver's name, tick, purpose). Nothing depends on the order of asking, on how
many ticks are computed at once, on the number of processes, or on which other edges there are. Renaming an agent
changes the draws of its edges; moving it in the file does not.

The generator is Threefry-2x64 with 20 rounds (Salmon, Moraes, Dror, Shaw: "Parallel random numbers: as easy as 1, 2,
3", SC 2011; the Random123 library). Its 128-bit key is the BLAKE2b digest of seed and names, its 128-bit counter the
pair (tick // 2, BLAKE2b of the purpose); the two words that come out serve an even tick and the odd one after it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from network.messages import Floats, Ints

Words = NDArray[np.uint64]

_ROTATIONS = (16, 42, 12, 31, 16, 32, 24, 21)
_ROUNDS = 20
_PARITY = np.uint64(0x1BD11BDAA9FC1A22)

_WORDS_AT_ONCE = 2**14  # keeps the working arrays in the second-level cache
_TICKS_AT_ONCE = 256  # the most; even, as one evaluation serves two ticks


def threefry2x64(counter: tuple[Words, Words], key: tuple[Words, Words]) -> tuple[Words, Words]:
    """Threefry-2x64-20, element by element.

    Args:
        counter: the two counter words, of shapes that broadcast with each other and with the key.
        key: the two key words.

    Returns:
        The two output words, of the common shape.
    """
    schedule = (key[0], key[1], key[0] ^ key[1] ^ _PARITY)
    shape = np.broadcast_shapes(*(words.shape for words in (*counter, *key)))
    x0, x1, shifted = (np.empty(shape, np.uint64) for _ in range(3))
    np.add(counter[0], key[0], out=x0)
    np.add(counter[1], key[1], out=x1)
    for index in range(_ROUNDS):
        rotation = _ROTATIONS[index % 8]
        x0 += x1
        np.left_shift(x1, rotation, out=shifted)
        x1 >>= 64 - rotation
        x1 |= shifted
        x1 ^= x0
        if index % 4 == 3:
            injection = index // 4 + 1
            x0 += schedule[injection % 3]
            x1 += schedule[(injection + 1) % 3] + injection
    return x0, x1


def _digest(size: int, *parts: str) -> bytes:
    """BLAKE2b of the parts, each preceded by its length, so that no two lists of parts read the same."""
    digest = hashlib.blake2b(digest_size=size)
    for part in parts:
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.digest()


def _words(data: bytes) -> Words:
    return np.frombuffer(data, "<u8").astype(np.uint64)


def _unit(words: Words) -> Floats:
    """The upper 53 bits of each word as a float64 in [0, 1)."""
    return (words >> 11).astype(np.float64) * 2.0**-53


class Draws:
    """The random numbers of `n` edges.

    Args:
        seed: of the run.
        sender_names: (n,) names of the sending agents.
        receiver_names: (n,) names of the receiving agents.
    """

    def __init__(self, seed: int, sender_names: Sequence[str], receiver_names: Sequence[str]) -> None:
        names = zip(sender_names, receiver_names, strict=True)
        keys = _words(b"".join(_digest(16, "edge", str(seed), sender, receiver) for sender, receiver in names))
        self._key = (keys[0::2].copy(), keys[1::2].copy())
        self._seed, self._senders = seed, tuple(sender_names)
        self._block = max(2, min(_TICKS_AT_ONCE, _WORDS_AT_ONCE // max(1, len(self._key[0])) // 2 * 2))
        self._blocks: dict[str, tuple[int, Floats]] = {}  # by purpose: index of the block, (ticks, n) uniforms

    def of_senders(self) -> Draws:
        """Numbers that all edges from one sender share: keyed by its name alone."""
        return Draws(self._seed, self._senders, [""] * len(self._senders))

    def uniform(self, purpose: str, tick: int) -> Floats:
        """(n,) float64, uniform over the multiples of 2^-53 in [0, 1). Read only."""
        index, row = divmod(tick, self._block)
        cached = self._blocks.get(purpose)
        if cached is None or cached[0] != index:
            cached = self._blocks[purpose] = (index, self._compute(purpose, index))
        uniforms: Floats = cached[1][row]
        return uniforms

    def uniforms(self, purpose: str, ticks: range) -> Floats:
        """(len(ticks), n) `uniform` of ticks in a row. Read only."""
        rows, tick = [], ticks.start
        while tick < ticks.stop:
            self.uniform(purpose, tick)
            index, row = divmod(tick, self._block)
            rows.append(self._blocks[purpose][1][row : row + ticks.stop - tick])
            tick = (index + 1) * self._block
        return rows[0] if len(rows) == 1 else np.concatenate(rows or [np.empty((0, len(self._key[0])))])

    def at(self, purpose: str, tick: Ints, edge: Ints) -> Floats:
        """(m,) `uniform` of some edges (indices), each at a tick of its own."""
        counter = (tick // 2).astype(np.uint64), _words(_digest(8, purpose))
        even, odd = threefry2x64(counter, (self._key[0][edge], self._key[1][edge]))
        return _unit(np.where(tick % 2 == 0, even, odd))

    def _compute(self, purpose: str, index: int) -> Floats:
        pairs = np.arange(index * self._block // 2, (index + 1) * self._block // 2, dtype=np.uint64)
        even, odd = threefry2x64((pairs[:, None], _words(_digest(8, purpose))), self._key)
        uniforms = np.empty((self._block, len(self._key[0])))
        uniforms[0::2] = _unit(even)
        uniforms[1::2] = _unit(odd)
        uniforms.flags.writeable = False
        return uniforms


def _initial_words(seed: int, paths: Sequence[str], n: int) -> Words:
    """(n_paths, n) words keyed by (seed, path, element)."""
    keys = _words(b"".join(_digest(16, "initial", str(seed), path) for path in paths)).reshape(-1, 2)
    zero = np.zeros(1, np.uint64)
    return threefry2x64((np.arange(n, dtype=np.uint64), zero), (keys[:, :1].copy(), keys[:, 1:].copy()))[0]


def initial_uniform(seed: int, paths: Sequence[str], n: int) -> Floats:
    """Uniform initial conditions.

    Args:
        seed: of the run.
        paths: whose values they are, for instance `arm3.plant.p`. Different paths give independent numbers.
        n: number of elements of each; element i is the same whatever `n` is.

    Returns:
        (n_paths, n) float64 in [0, 1).
    """
    return _unit(_initial_words(seed, paths, n))


def initial_normal(seed: int, paths: Sequence[str], n: int) -> Floats:
    """Standard normal initial conditions: the inverse distribution function of keyed uniforms; arguments as above.

    Returns:
        (n_paths, n) float64 of mean 0 and variance 1.
    """
    from statistics import NormalDist

    # 52 bits and half a step: symmetric about 1/2, and never 0 or 1, where the inverse is infinite.
    probabilities = ((_initial_words(seed, paths, n) >> 12) + 0.5) * 2.0**-52
    inverse = NormalDist().inv_cdf
    values = [inverse(probability) for probability in probabilities.ravel().tolist()]
    return np.array(values, dtype=np.float64).reshape(probabilities.shape)
