"""Train a policy by behaviour cloning, and write it as ONNX with its card. Needs the extra `train`.

    python -m examples.policy.train demonstrations.npz pick_ball.onnx

The network: three convolutions give maps, whose centers of mass (spatial soft-argmax, Finn et al., "Deep spatial
autoencoders for visuomotor learning", 2016) and means go with the state into four layers. They return a chunk of
`ROWS` rows: joint positions relative to the observed ones, and the width of the gripper. Training adds noise to the
state and leads back to the demonstration, so that small errors do not grow (as DART, Laskey et al., 2017, but on the
recorded states). The ball's position is a second target of the features, in training only.
"""

import argparse
import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

RATE, ROWS = 20.0, 20  # [Hz]
DOF, OPEN = 7, 0.08  # [m]
MAPS = 16
EPISODES, STATES, EMPTY = 24, 24, 6  # of a batch: episodes, frames of each, images without a ball
SEEING_STEPS, STEPS, LEARNING_RATE = 1500, 9000, 2e-3
VARIATIONS = 4  # of each image whose features are stored
POSITION_NOISE, CLOSING_NOISE = (0.003, 0.010, 0.025), 0.004  # [rad] one of these; next to closing fingers
VELOCITY_NOISE, GRIPPER_NOISE = 0.03, 0.0005  # [rad/s], [m]
RETURN_ROWS = 7  # in which the noise of positions is led back to zero
STILL = 0.2  # share of samples whose velocity is hidden
CHECKED = 0.04  # share of the episodes that are not trained on
SEED = 0
OPSET = 17


class Policy(nn.Module):
    """Chunk (n, ROWS, DOF + 1) of images (n, 3, 96, 96) RGB from 0 to 1 and states (n, 15)."""

    def __init__(self, size: int = 96) -> None:
        super().__init__()
        self.see = nn.Sequential(nn.Conv2d(3, 16, 5, 2, 2), nn.ReLU(), nn.Conv2d(16, 24, 3, 1, 1), nn.ReLU(),
                                 nn.Conv2d(24, MAPS, 3, 1, 1))
        side = size // 2
        v, u = torch.meshgrid(torch.linspace(-1, 1, side), torch.linspace(-1, 1, side), indexing="ij")
        self.register_buffer("grid", torch.stack([u, v], -1).reshape(-1, 2))
        self.register_buffer("center", torch.zeros(2 * DOF + 1))
        self.register_buffer("spread", torch.ones(2 * DOF + 1))
        self.register_buffer("reach", torch.ones(ROWS, DOF))
        width = 3 * MAPS
        self.decide = nn.Sequential(
            nn.Linear(width + 2 * DOF + 1, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 256),
            nn.ReLU(), nn.Linear(256, ROWS * (DOF + 1)))
        self.ball = nn.Sequential(nn.Linear(width, 64), nn.ReLU(), nn.Linear(64, 3))  # x, y [m] and whether seen

    def features(self, image: torch.Tensor) -> torch.Tensor:
        """Return (n, 3 MAPS): center of mass and mean of each map."""
        maps = self.see(image - 0.5).flatten(2)
        centers = torch.softmax(maps, 2) @ self.grid
        means = torch.tanh(torch.relu(maps).mean(2).clamp(0.0, 20.0))  # OpenCV's Tanh returns NaN for large values
        return torch.cat([centers.flatten(1), means], 1)

    def act(self, features: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Return steps from the observed positions, as shares of `reach`, and the width of the gripper from 0 to 1."""
        found = self.decide(torch.cat([features, (state - self.center) / self.spread], 1))
        return found.reshape(-1, ROWS, DOF + 1)

    def forward(self, image: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Return steps [rad], and widths [m]."""
        found = self.act(self.features(image), state)
        return torch.cat([found[..., :DOF] * self.reach, found[..., DOF:] * OPEN], 2)


@dataclass
class Demonstrations:
    """Frames (n, ...) and the episodes' first frame and length (e,), as tensors."""

    state: torch.Tensor
    steps: torch.Tensor  # (n, ROWS, DOF + 1): positions of the rows [rad], widths from 0 to 1
    sees: torch.Tensor  # (n,) whether the ball is in the image
    closing: torch.Tensor  # (n,) whether the fingers close soon, at the ball
    images: torch.Tensor  # (e, 3, h, w) uint8, with the ball
    empty: torch.Tensor  # (k, 3, h, w) uint8, without
    ball: torch.Tensor  # (e, 2)
    first: torch.Tensor
    length: torch.Tensor

    @classmethod
    def read(cls, path: Path) -> "Demonstrations":
        """Read a file of `examples.policy.demonstrate`."""
        data = np.load(path)
        episode, q, command = data["episode"], data["positions"], data["command"]
        first = np.flatnonzero(np.diff(episode, prepend=-1))
        last = np.append(first[1:], len(episode))[episode] - 1
        ahead = np.minimum(np.arange(len(q))[:, None] + np.arange(1, ROWS + 1), last[:, None])
        steps = np.concatenate([q[ahead], command[ahead][..., None] / OPEN], 2)
        start = data["image"][first]  # each episode begins with the ball in view
        sees = data["image"] == start[episode]
        state = np.column_stack([q, data["velocities"], data["gripper"]])
        images = data["images"].transpose(0, 3, 1, 2)
        empty = np.setdiff1d(np.arange(len(images)), start)[:64]
        closing = sees & (command[np.minimum(np.arange(len(q)) + 6, last)] < OPEN / 2)
        as_tensor = lambda values: torch.from_numpy(np.ascontiguousarray(values, np.float32))  # noqa: E731
        return cls(as_tensor(state), as_tensor(steps), torch.from_numpy(sees), torch.from_numpy(closing),
                   torch.from_numpy(images[start]), torch.from_numpy(images[empty]), as_tensor(data["ball"][:, :2]),
                   torch.from_numpy(first), torch.from_numpy(np.diff(np.append(first, len(q)))))


def varied(images: torch.Tensor) -> torch.Tensor:
    """Return images from 0 to 1 with random brightness, contrast and noise."""
    n = len(images)
    gain, offset = 1 + 0.15 * torch.randn(n, 1, 1, 1).clamp(-2, 2), 0.05 * torch.randn(n, 1, 1, 1)
    noise = 0.03 * torch.rand(n, 1, 1, 1) * torch.randn(images.shape)
    return ((images.float() / 255 - 0.5) * gain + 0.5 + offset + noise).clamp(0, 1)


def disturbed(data: Demonstrations, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return states with noise, and what leads from them back to the demonstrations."""
    state, steps = data.state[rows].clone(), data.steps[rows].clone()
    level = torch.tensor(POSITION_NOISE)[torch.randint(len(POSITION_NOISE), (len(rows), 1))]
    level = torch.where(data.closing[rows][:, None], torch.tensor(CLOSING_NOISE), level)
    noise = level * torch.randn(len(rows), DOF)
    left = (1 - torch.arange(1, ROWS + 1) / RETURN_ROWS).clamp(min=0) ** 2
    steps[..., :DOF] += left[None, :, None] * noise[:, None] - (state[:, None, :DOF] + noise[:, None])
    state[:, :DOF] += noise
    state[:, DOF:2 * DOF] += VELOCITY_NOISE * torch.randn(len(rows), DOF)
    state[:, DOF:2 * DOF] *= (torch.rand(len(rows), 1) > STILL).float()
    state[:, 2 * DOF:] += GRIPPER_NOISE * torch.randn(len(rows), 1)
    return state, steps


def fit(data: Demonstrations, steps: int, progress=print) -> tuple[Policy, dict]:
    """Return the trained network and its errors on the episodes that were not trained on.

    The first `SEEING_STEPS` train all of it, the others what decides, on stored features of varied images.
    """
    torch.manual_seed(SEED)
    torch.set_num_threads(1)
    model = Policy(data.images.shape[-1])
    model.center[:], model.spread[:] = data.state.mean(0), data.state.std(0).clamp(min=1e-3)
    moved = data.steps[..., :DOF] - data.state[:, None, :DOF]
    model.reach[:] = moved.abs().mean(0).clamp(min=0.01) + 0.01
    order = torch.randperm(len(data.first))
    split = round(CHECKED * len(order))
    check, train = order[:split], order[split:]
    _train(model, data, train, check, SEEING_STEPS, model.parameters(), None, progress)
    with torch.no_grad():
        stored = [torch.cat([model.features(varied(part)) for part in torch.cat([data.images, data.empty]).split(100)])
                  for _ in range(VARIATIONS)]
    _train(model, data, train, check, steps, model.decide.parameters(), torch.stack(stored), progress)
    return model.eval(), errors_of(model, data, check)


def _train(
    model: Policy, data: Demonstrations, train: torch.Tensor, check: torch.Tensor, steps: int, learned,
    stored: torch.Tensor | None, progress,
) -> None:
    optimizer = torch.optim.AdamW(learned, LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, steps, pct_start=0.1)
    began, losses = time.process_time(), []
    for number in range(1, steps + 1):
        chosen = train[torch.randint(len(train), (EPISODES if stored is None else 3 * EPISODES,))]
        empty = torch.randint(len(data.empty), (EMPTY,))
        if stored is None:
            seen = model.features(varied(torch.cat([data.images[chosen], data.empty[empty]])))
        else:
            rows = torch.cat([chosen, len(data.first) + empty])
            seen = stored[torch.randint(len(stored), (len(rows),)), rows]
        loss = action_loss(model, data, chosen, seen)
        if stored is None:
            loss = loss + ball_loss(model, data, chosen, seen)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        if number % 500 == 0 or number == steps:
            progress(f"step {number}: loss {np.mean(losses):.4f}, {errors_of(model, data, check)}, "
                     f"{time.process_time() - began:.0f} s", flush=True)
            losses = []


def action_loss(model: Policy, data: Demonstrations, chosen: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Return the loss of actions for random frames of some episodes (k,).

    `seen` (k + EMPTY, features) are of their images, then of images without a ball.
    """
    frame = (torch.rand(len(chosen), STATES) * data.length[chosen][:, None]).long()
    rows = (data.first[chosen][:, None] + frame).flatten()
    which = torch.where(data.sees[rows], torch.arange(len(chosen)).repeat_interleave(STATES),
                        len(chosen) + torch.randint(EMPTY, (len(rows),)))
    state, steps = disturbed(data, rows)
    found = model.act(seen[which], state)
    return ((found[..., :DOF] - steps[..., :DOF] / model.reach).abs().mean()
            + (found[..., DOF] - steps[..., DOF]).abs().mean())


def ball_loss(model: Policy, data: Demonstrations, chosen: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Return the loss of the position of the ball and of whether it is seen; see `action_loss`."""
    place = model.ball(seen)
    present = (torch.arange(len(seen)) < len(chosen)).float()
    return (10 * (place[:len(chosen), :2] - data.ball[chosen]).abs().mean()
            + nn.functional.binary_cross_entropy_with_logits(place[:, 2], present))


def errors_of(model: Policy, data: Demonstrations, episodes: torch.Tensor) -> dict:
    """Return mean errors on all frames of episodes: of the first and last row [mrad], of widths, of the ball [mm]."""
    with torch.no_grad():
        seen, empty = model.features(data.images[episodes] / 255), model.features(data.empty[:1] / 255)
        steps, widths = [], []
        for number, episode in enumerate(episodes.tolist()):
            rows = torch.arange(data.first[episode], data.first[episode] + data.length[episode])
            features = torch.where(data.sees[rows][:, None], seen[number], empty[0])
            found = model.act(features, data.state[rows])
            true = data.steps[rows][..., :DOF] - data.state[rows][:, None, :DOF]
            steps.append((found[..., :DOF] * model.reach - true).abs().mean(2))
            widths.append(((found[..., DOF] > 0.5) == (data.steps[rows][..., DOF] > 0.5)).float().mean(1))
        error = torch.cat(steps).mean(0) * 1e3
        away = (model.ball(seen)[:, :2] - data.ball[episodes]).norm(dim=1) * 1e3
    return {"first_row_mrad": round(error[0].item(), 2), "last_row_mrad": round(error[-1].item(), 2),
            "widths": round(torch.cat(widths).mean().item(), 4), "ball_mm": round(away.mean().item(), 2)}


def export(model: Policy, out: Path) -> None:
    """Write the network as ONNX, with inputs `image` and `state` and the output `actions`."""
    size = round(len(model.grid) ** 0.5) * 2
    example = torch.zeros(1, 3, size, size), torch.zeros(1, 2 * DOF + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the newer exporter needs two more packages
        torch.onnx.export(model, example, str(out), dynamo=False, opset_version=OPSET, input_names=["image", "state"],
                          output_names=["actions"])


LIMITS = [
    "One red ball of 60 mm on the table of the cell policy_panda, seen by its camera, in images without the arm.",
    "Layouts nearer to the base than 0.29 m, where the posture of home does not reach, are hardly in the data.",
    "It was trained and evaluated in the kinematic world only: no contact forces, no real images, no delay of an arm.",
    "The ball's true position was a second target of training; the network that runs has no such output.",
]


def card_of(data: dict, errors: dict, parameters: int, minutes: float) -> dict:
    """Return the card of the network; `examples.policy.evaluate --card` adds the figures of whole picks."""
    return {
        "format": 1, "joints": [f"panda_joint{number}" for number in range(1, DOF + 1)], "kind": "joint_steps",
        "rate": RATE, "rows": ROWS, "gripper": True, "state": ["positions", "velocities", "gripper"],
        "images": {"camera": "image"}, "image_size": list(data["images"].shape[2:0:-1]), "output": "actions",
        "training": {
            "method": "behaviour cloning of the planners ptp and lin, examples/policy/train.py",
            "episodes": len(data["seed"]), "frames": len(data["episode"]),
            "layouts": f"seeds {data['seed'].min()} to {data['seed'].max()}", "seed": SEED,
            "checked_episodes": round(CHECKED * len(data["seed"])), "errors_on_checked_episodes": errors,
            "parameters": parameters, "processor_minutes": minutes, "torch": torch.__version__, "limits": LIMITS,
        },
    }


def main() -> None:
    """Train, and write the network and its card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="file of examples.policy.demonstrate")
    parser.add_argument("out", type=Path, help=".onnx file; the card is written next to it as .json")
    parser.add_argument("--steps", type=int, default=STEPS)
    given = parser.parse_args()
    began = time.process_time()
    model, errors = fit(Demonstrations.read(given.data), given.steps)
    export(model, given.out)
    parameters = sum(value.numel() for name, value in model.named_parameters() if not name.startswith("ball"))
    minutes = round((time.process_time() - began) / 60, 1)
    card = card_of(dict(np.load(given.data)), errors, parameters, minutes)
    given.out.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    print(f"{given.out}: {given.out.stat().st_size} bytes, {minutes} minutes, {errors}")


if __name__ == "__main__":
    main()
