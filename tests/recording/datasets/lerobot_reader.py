"""Reads a LeRobotDataset with lerobot's own loader and saves what it returns: run by the Python that has lerobot."""

import sys

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def main(folder: str, target: str) -> None:
    dataset = LeRobotDataset("zencell/test", root=folder, video_backend="pyav")
    items = [dataset[k] for k in range(len(dataset))]
    columns = {key: np.array([np.asarray(item[key]) for item in items]) for key in items[0]}
    windowed = LeRobotDataset("zencell/test", root=folder, video_backend="pyav",
                              delta_timestamps={"action": [0, 1 / dataset.fps]})
    np.savez(target, allow_pickle=False, fps=dataset.fps, episodes=dataset.num_episodes,
             windows=np.array([np.asarray(windowed[k]["action"]) for k in range(len(windowed))]),
             means=dataset.meta.stats["observation.state"]["mean"], **columns)


if __name__ == "__main__":
    main(*sys.argv[1:])
