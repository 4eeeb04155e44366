"""How likely recorded transitions of YuMi Pusher are under a psi, by the simulator itself.

What a transition starts from is measured with known noise. The next measured state is normal about what the simulator
makes of such starts: with the mean and the covariance of many, and new noise. Transitions count as independent.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models.yumi_pusher import (
    CHUNK,
    NOISE_JOINT,
    NOISE_PLACE,
    NOISE_TURN,
    NOISE_VELOCITY,
    PRIOR,
    SUBSTEPS,
)
from det2stoc_bayes.transitions import Transitions

ROUGHLY = (2, 40)  # starts that each psi is tried from, and all of them, while the most likely psi is looked for
TELLING = 2e-4  # share of the information about psi that a transition must have to be kept
SOLVED = 2  # Gauss-Newton turns of an arm's positions, which start within 1e-3 rad
CLIMBED = 3  # turns to the most likely psi under one covariance
NUDGES = np.array([0.004, 0.0012])  # of psi, in finite differences: about two sds of an episode's posterior


def misses(full: Float[np.ndarray, "rows 41"], seen: Float[np.ndarray, "rows 60"]) -> Float[np.ndarray, "rows 52"]:
    """Measured states less the simulator's own, in sds of the noise, all independent: a turn has three numbers."""
    state = yumi_pusher.state_of(full)
    off = seen - state

    def turned(own: Rotation, measured: Rotation) -> Float[np.ndarray, "rows 3"]:
        return (own.inv() * measured).as_rotvec() / NOISE_TURN

    out = [off[:, :28] / NOISE_JOINT]
    for i in (28, 35):
        poses = (Rotation.from_quat(s[:, i + 3 : i + 7], scalar_first=True) for s in (state, seen))
        out += [off[:, i : i + 3] / NOISE_PLACE, turned(*poses)]
    boxes = (Rotation.from_matrix(s[:, 45:54].reshape(-1, 3, 3)) for s in (state, seen))
    out += [off[:, 42:45] / NOISE_PLACE, turned(*boxes), off[:, 54:] / NOISE_VELOCITY]
    return np.concatenate(out, 1)


@dataclass(frozen=True, eq=False)
class Starts:
    """The simulator's own states that measured ones leave possible: normal, where nothing else is known of them."""

    centre: Float[np.ndarray, "rows 41"]
    joints: Float[np.ndarray, "rows 2 7 7"]  # Cholesky factors of each arm's positions

    @classmethod
    def of(cls, seen: Float[np.ndarray, "rows 60"]) -> Self:
        """From measured states; an arm's positions are told by its joints and by where its end is."""
        centre, factors = np.empty((len(seen), 41)), np.empty((len(seen), 2, 7, 7))
        centre[:, :3], centre[:, 21:27], centre[:, 27:] = seen[:, 42:45], seen[:, 54:], seen[:, 14:28]
        centre[:, 3:7] = Rotation.from_matrix(seen[:, 45:54].reshape(-1, 3, 3)).as_quat(scalar_first=True)
        noise = np.repeat([NOISE_PLACE, NOISE_TURN], 3)
        for i, arm in enumerate(yumi_pusher.arms()):
            read, end = seen[:, 7 * i : 7 * i + 7], seen[:, 28 + 7 * i : 35 + 7 * i]
            held, q = Rotation.from_quat(end[:, 3:], scalar_first=True), read
            for _ in range(SOLVED):
                place, turn, jacobian = arm.pose(q)
                apart = (held * Rotation.from_matrix(turn).inv()).as_rotvec()
                white = jacobian / noise[:, None]
                precision = np.eye(7) / NOISE_JOINT**2 + np.einsum("sij,sik->sjk", white, white)
                pull = np.einsum("sij,si->sj", white, np.concatenate([end[:, :3] - place, apart], 1) / noise)
                q = q + np.linalg.solve(precision, (pull + (read - q) / NOISE_JOINT**2)[..., None])[..., 0]
            centre[:, 7 + 7 * i : 14 + 7 * i], factors[:, i] = q, np.linalg.cholesky(np.linalg.inv(precision))
        return cls(centre, factors)

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "draws rows 41"]:
        """An even number of them, in pairs on either side of the centre: their mean is the centre."""
        half = random.standard_normal((count // 2, len(self.centre), 40))
        z, out = np.concatenate([half, -half]), np.repeat(self.centre[None], 2 * (count // 2), 0)
        out[..., :3] += NOISE_PLACE * z[..., :3]
        turn = Rotation.from_rotvec(NOISE_TURN * z[..., 3:6].reshape(-1, 3))
        own = Rotation.from_quat(out[..., 3:7].reshape(-1, 4), scalar_first=True)
        out[..., 3:7] = (own * turn).as_quat(scalar_first=True).reshape(*out.shape[:2], 4)
        for i in range(2):
            mine = slice(7 + 7 * i, 14 + 7 * i)
            out[..., mine] += np.einsum("rij,drj->dri", self.joints[:, i], z[..., 6 + 7 * i : 13 + 7 * i])
        out[..., 21:27] += NOISE_VELOCITY * z[..., 20:26]
        out[..., 27:] += NOISE_JOINT * z[..., 26:]
        return out


def stepped(
    psi: Float[np.ndarray, "sims 2"], starts: Float[np.ndarray, "sims rows 41"], actions: Float[np.ndarray, "rows 14"]
) -> Float[np.ndarray, "sims rows 41"]:
    """One sample on from each start, every time anew."""
    out, model = np.empty(starts.shape), yumi_pusher.load_model()
    for begin in range(0, len(psi), CHUNK):
        sims = slice(begin, begin + CHUNK)
        batch = yumi_pusher.prepared(model, psi[sims])
        qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        warm = batch.bind("qacc_warmstart")
        for k, action in enumerate(actions):
            qpos[:], qvel[:], ctrl[:], warm[:] = starts[sims, k, :21], starts[sims, k, 21:], action, 0.0
            batch.step(nstep=SUBSTEPS)
            out[sims, k, :21], out[sims, k, 21:] = qpos, qvel
    return out


@dataclass(frozen=True, eq=False)
class EpisodeLikelihood:
    """log density of an episode's transitions as a function of psi.

    Each psi is tried from the same few starts. The covariance, and by how much the mean of many starts differs from
    that of the few, were found at one psi.
    """

    starts: Float[np.ndarray, "draws rows 41"]
    actions: Float[np.ndarray, "rows 14"]
    after: Float[np.ndarray, "rows 60"]
    shift: Float[np.ndarray, "rows 52"]
    root: Float[np.ndarray, "rows 52 52"]  # root root' is the inverse covariance

    @classmethod
    def at(
        cls,
        psi: Float[np.ndarray, " 2"],
        recorded: Transitions,
        random: np.random.Generator,
        num_draws: int,
        num_spread: int,
    ) -> Self:
        """Found at a psi from `num_spread` starts, of which each psi is then tried from `num_draws`; even numbers."""
        starts, after = Starts.of(recorded.state).draw(random, num_spread), recorded.state + recorded.change
        few = np.r_[: num_draws // 2, num_spread // 2 : num_spread // 2 + num_draws // 2]  # pairs stay together
        off = _missed(psi[None], starts, recorded.action, after)[0]
        mean = off.mean(0)
        spread = np.einsum("dri,drj->rij", off - mean, off - mean) / (num_spread - 1)
        root = np.linalg.cholesky(np.linalg.inv(spread + np.eye(spread.shape[1])))
        return cls(starts[few], recorded.action, after, mean - off[few].mean(0), root)

    def white(self, psi: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points rows 52"]:
        """What each psi misses the recorded states by, as independent standard normals."""
        mean = _missed(psi, self.starts, self.actions, self.after).mean(1) + self.shift
        return np.einsum("rij,pri->prj", self.root, mean)

    def __call__(self, psi: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
        """The log density, up to a constant."""
        return -0.5 * (self.white(psi) ** 2).sum((1, 2))

    def climb(self, psi: Float[np.ndarray, " 2"]) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, "rows 2 2"]]:
        """The most likely psi within psi_0, and what each transition tells about it there, by Gauss-Newton."""
        information = np.zeros((len(self.after), 2, 2))
        for _ in range(CLIMBED):
            probes = psi + np.concatenate([np.zeros((1, 2)), np.diag(NUDGES), -np.diag(NUDGES)])
            white = self.white(probes)
            slope = (white[1:3] - white[3:]) / (2 * NUDGES[:, None, None])
            information = np.einsum("irk,jrk->rij", slope, slope)
            step = np.linalg.solve(information.sum(0), np.einsum("irk,rk->i", slope, white[0]))
            psi = np.clip(psi - step, PRIOR.low, PRIOR.high)
        return psi, information


def mode(
    recorded: Transitions, random: np.random.Generator, num_draws: int, num_spread: int
) -> tuple[EpisodeLikelihood, Float[np.ndarray, " 2"], Float[np.ndarray, "2 2"]]:
    """An episode's likelihood near its most likely psi, that psi, and the precision there.

    Transitions that tell nothing of psi (the box rests, the hand is far) are left out.
    """
    centre = np.mean([PRIOR.low, PRIOR.high], 0)
    psi, told = EpisodeLikelihood.at(centre, recorded, random, *ROUGHLY).climb(centre)
    share = np.einsum("rij,ji->r", told, np.linalg.inv(told.sum(0))) / 2
    likelihood = EpisodeLikelihood.at(psi, recorded[share > TELLING], random, num_draws, num_spread)
    psi, told = likelihood.climb(psi)
    return likelihood, psi, told.sum(0)


def _missed(
    psi: Float[np.ndarray, "points 2"],
    starts: Float[np.ndarray, "draws rows 41"],
    actions: Float[np.ndarray, "rows 14"],
    after: Float[np.ndarray, "rows 60"],
) -> Float[np.ndarray, "points draws rows 52"]:
    """What is recorded less what each psi makes of each start, in sds of the noise."""
    points, (draws, rows, _) = len(psi), starts.shape
    found = stepped(np.repeat(psi, draws, 0), np.tile(starts, (points, 1, 1)), actions)
    return misses(found.reshape(-1, 41), np.tile(after, (points * draws, 1))).reshape(points, draws, rows, -1)
