"""When each command acted, where a file does not have all of them.

A log of every second tick, or of a recorder beside the loop, shows a command at the first sample
after it was written: the valve had it up to a period before. One fill that acts 1 ms early leaves
a hundred times an encoder's noise. So each jump of the command gets a share of a period by which it
acts early, and what changes smoothly has one share together. They belong to the records, as a
sensor's zero does: they are fitted beside a model's own numbers, by bounded least squares.

It is asked only where the pressure shows it. At the sample at which a jump is first logged the
pressure cannot answer yet. Where it does at some jumps and not at others, commands are missing from
the file; where it does at all of them, a column is late, which is a fault of the set-up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from pamctl.diagnose.evidence.constants import COARSE_STEP_S, FINE_STEP_S
from pamctl.diagnose.evidence.fit import STEP, WeighedModel, Weigher
from pamctl.diagnose.evidence.likelihood import Likelihood, to_haar
from pamctl.diagnose.evidence.paraboloid import MOST_STEP
from pamctl.diagnose.evidence.run_pieces import Runs
from pamctl.diagnose.record import estimate_white_noise

Array = NDArray[np.float64]

BESIDE = 3
"""Samples on either side above which a jump stands out."""
STANDS_OUT, LEAST_JUMP = 3.0, 0.005
"""Times the largest change beside it, and share of the command's span, that make a jump."""
MOST_JUMPS = 64
"""In one stretch. A valve that is switched all the time has no instants that a fit could find."""
MOST_HELD = 32
"""Samples. A command that a file holds for longer was held by the program."""
SLOPE = 3
"""Samples over which the pressure's slope is taken on either side of a jump."""
SHARP = 8.0
"""Times the noise of a difference that a jump turns the pressure by in a period: then one sample
shows its share to an eighth."""
EARLY, IN_TIME = 0.3, 0.15
"""Shares of a sharp jump that is early, and of one that is not."""
FEWEST, FEWEST_SHARE = 2, 0.05
"""So many of each are needed, and such a share of all: one alone may be a spike."""
USUAL, WIDE = 0.3, 0.3
"""Mean and standard deviation of a share before anything is known of it."""
MOVE = 0.1
"""Of a period: the step of a difference."""
SETTLED, ROUNDS = 0.002, 8
"""When no share changes by more, the fit ends; and rounds at most."""
LOOSE, RIDGE, ROOM = 1e-4, 1e-12, 1e-9
"""So that a number that no sample shows stays, and one at its end has a range."""


def find_jumps(command_v: Array) -> NDArray[np.int64]:
    """Return the samples at which a command jumps, the MOST_JUMPS largest jumps of them."""
    change = np.abs(np.diff(command_v, prepend=command_v[0]))
    padded = np.pad(change, BESIDE)
    near = [padded[k : k + len(change)] for k in range(2 * BESIDE + 1) if k != BESIDE]
    stands_out = change > STANDS_OUT * np.max(near, axis=0)
    found = np.flatnonzero(stands_out & (change > LEAST_JUMP * np.ptp(command_v)))
    largest = np.argsort(-change[found], kind="stable")[:MOST_JUMPS]
    return np.sort(found[largest])


def find_refresh(commands_v: Sequence[Array]) -> int:
    """Return the samples between two that may hold a new command; 1 for all of them."""
    changes = [np.flatnonzero(np.diff(command_v)) for command_v in commands_v]
    every = int(np.gcd.reduce(np.concatenate([np.diff(at) for at in changes])))
    return every if 0 < every <= MOST_HELD else 1


class CommandInstants:
    """The shares of a refresh by which the commands of some records act before their samples."""

    def __init__(self, runs: Runs, weigher: Weigher) -> None:
        """Begin with commands that act at their samples."""
        self.runs, self.weigher = runs, weigher
        self.refresh = find_refresh([s.inputs["valve_v"] for s in runs.stretches])
        """Samples for which the file holds a command at least."""
        self.like = Likelihood(runs.find_kept(weigher.like.level), weigher.like.least2)
        laid_out = zip(runs.stretches, runs.sizes, strict=True)
        jumps = [find_jumps(s.inputs["valve_v"][:size]) for s, size in laid_out]
        ends = np.cumsum([0, *runs.sizes]).tolist()
        self.parts = [slice(*pair) for pair in pairwise(ends)]
        """The samples of each stretch."""
        self.owner = np.repeat(np.arange(len(jumps)), [*map(len, jumps)])
        """The stretch of each jump, shape (jumps,)."""
        self.order = np.concatenate([np.arange(len(j)) for j in jumps])
        """Its number in its stretch."""
        self.sample = np.concatenate(jumps)
        """Its sample in its stretch."""
        self.shares = np.zeros(len(self.owner) + 1)
        """Of each jump, and of what changes smoothly, shape (jumps + 1,)."""

    @property
    def early(self) -> int:
        """The number of jumps that act surely before their samples."""
        return int((self.shares[:-1] > IN_TIME).sum())

    def measure_shares(self) -> Array:
        """Set each share to what the pressure shows of it; return those of the sharp jumps.

        The pressure rises along one line before a jump, and along another after it: where they
        meet, the command acted. No model is asked, since it may be wrong.
        """
        row, every = self.runs.channels.index("pressure_pa"), self.refresh
        shares, sharp = [], []
        for number, stretch in enumerate(self.runs.stretches):
            p = stretch.shown[row]
            noise = max(estimate_white_noise(p), float(np.sqrt(self.like.least2[row])))
            at = self.sample[self.owner == number]
            at = np.clip(at, every + SLOPE, len(p) - SLOPE - 1)
            before = (p[at - every] - p[at - every - SLOPE]) / SLOPE
            turn = every * ((p[at + SLOPE] - p[at]) / SLOPE - before)
            seen = (p[at] - p[at - every] - every * before) / np.where(turn == 0.0, 1.0, turn)
            gone = [stretch.masked[row][at + k] for k in range(-every - SLOPE, SLOPE + 1)]
            sure = np.where(np.any(gone, axis=0), 0.0, turn / (np.sqrt(2.0) * noise))
            shares.append((sure**2 * seen + WIDE**-2 * USUAL) / (sure**2 + WIDE**-2))
            sharp.append(seen[np.abs(sure) > SHARP])
        found = np.concatenate(sharp)
        usual = found.mean() if len(found) else 0.0
        self.shares = np.clip(np.append(np.concatenate(shares), usual), 0.0, 1.0)
        return found

    def put(self, shares: Array) -> None:
        """Let the commands of the records act so early."""
        late_s = []
        for number, stretch in enumerate(self.runs.stretches):
            early = np.full(len(stretch.inputs["valve_v"]), shares[-1])
            mine = self.owner == number
            early[self.sample[mine]] = shares[:-1][mine]
            late_s.append(-self.refresh * self.runs.period_s * early)
        self.runs.set_instants(late_s)

    def fit(self, m: WeighedModel) -> None:
        """Fit the shares together with a model's numbers, by Gauss and Newton; keep the shares.

        The model's residual is then no longer that of the records: fit it again.
        """
        count, scale = len(self.shares), np.array([n.scale for n in m.numbers])
        ends = np.array([(n.low, n.high) for n in m.numbers])
        low, high = (np.append(np.full(count, k), (ends[:, k] - m.x) / scale) for k in (0, 1))
        usual = np.append(np.full(count, USUAL), np.zeros(len(scale)))
        prior = np.append(np.full(count, WIDE**-2), np.full(len(scale), LOOSE))
        z = np.append(self.shares, np.zeros(len(scale)))
        for _ in range(ROUNDS):
            here = self._show(m, z, FINE_STEP_S)
            d = self._to_haar(self.runs.shown.reshape(here.shape) - here)
            columns = np.stack([*self._find_columns(m, z)])
            weighed = columns * self.like(d, self.like.least2).weights.ravel()
            normal = weighed @ columns.T + np.diag(prior)
            root = np.linalg.cholesky(normal + RIDGE * np.diag(np.diag(normal)))
            slope = weighed @ d.ravel() + prior * (z - usual)
            room = np.maximum(low - z, -MOST_STEP) - ROOM, np.minimum(high - z, MOST_STEP) + ROOM
            step = lsq_linear(root.T, -np.linalg.solve(root, slope), room).x
            z = np.clip(z + step, low, high)
            if np.abs(step[:count]).max() < SETTLED:
                break
        self.shares = z[:count]
        self.put(self.shares)

    def _show(self, m: WeighedModel, z: Array, step_s: float = COARSE_STEP_S) -> Array:
        """Return what a plant shows, shape (channels, samples).

        z holds the shares, and by how many scales the model's numbers are moved.
        """
        count, values = len(self.shares), {**self.weigher.base, **m.values}
        for n, value, move in zip(m.numbers, m.x, z[count:], strict=True):
            values[n.name] = float(value + move * n.scale)
        self.put(z[:count])
        rows = self.runs.simulate(values, step_s)
        return rows.reshape(len(rows), -1)

    def _to_haar(self, off: Array) -> Array:
        return to_haar(self.runs.fill_masked(off.reshape(self.runs.shown.shape)))

    def _find_columns(self, m: WeighedModel, z: Array) -> Iterator[Array]:
        """Yield the change of the residual for a unit of each number in z.

        One simulation moves a jump in every stretch.
        """
        here, jumps, numbers = self._show(m, z), len(self.owner), np.arange(len(z))
        move = np.where(numbers < len(self.shares), np.where(z > 0.5, -MOVE, MOVE), STEP)
        order = np.append(self.order, np.full(len(z) - jumps, -1))
        moved = [
            self._show(m, z + move * (order == number))
            for number in range(int(order.max(initial=-1)) + 1)
        ]
        for owner, number, h in zip(self.owner, self.order, move, strict=False):
            change, part = np.zeros_like(here), self.parts[owner]
            change[:, part] = (here - moved[number])[:, part] / h
            yield self._to_haar(change).ravel()
        for i in numbers[jumps:]:
            rows = self._show(m, z + move * (numbers == i))
            yield self._to_haar((here - rows) / move[i]).ravel()


def find_instants(weigher: Weigher) -> list[CommandInstants]:
    """Return when the commands acted, for each set of records; empty where they act in time.

    It is not asked where a file says when its commands act, or where valve or pressure is missing.
    """
    sets = [weigher.train.whole, *([weigher.held_out.whole] if weigher.held_out else [])]
    sets = sets[:1] if sets[0] is sets[-1] else sets
    stretches = [s for runs in sets for s in runs.stretches]
    if "pressure_pa" not in sets[0].channels or "valve_v" not in stretches[0].inputs:
        return []
    if any(s.grids.acts_after_s is not None for s in stretches):
        return []
    found = [CommandInstants(runs, weigher) for runs in sets]
    lacking = [_lacks_commands(each.measure_shares()) for each in found]
    if not any(lacking):
        return []
    for each in found:
        each.put(each.shares)
    return found


def _lacks_commands(sharp: Array) -> bool:
    """Tell whether some sharp jumps act before their samples, and others at them."""
    early, in_time = (sharp > EARLY).sum(), (np.abs(sharp) < IN_TIME).sum()
    return bool(min(early, in_time) >= max(FEWEST, FEWEST_SHARE * len(sharp)))
