"""Reads an HDF5 file with robomimic's own loader and saves what it returns: run by the Python that has robomimic."""

import sys

import numpy as np
from robomimic.utils import obs_utils
from robomimic.utils.dataset import SequenceDataset

LOW, IMAGES = ["joint_pos", "gripper_width"], ["camera_image"]


def main(path: str, target: str) -> None:
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": LOW, "rgb": IMAGES}})
    found = {}
    for part in ("train", "valid"):
        dataset = SequenceDataset(
            path, obs_keys=LOW + IMAGES, dataset_keys=["actions", "rewards", "dones"], seq_length=1,
            filter_by_attribute=part, load_next_obs=False)
        items = [dataset[k] for k in range(len(dataset))]
        found[f"{part}_actions"] = np.array([item["actions"][0] for item in items])
        found |= {f"{part}_{key}": np.array([item["obs"][key][0] for item in items]) for key in LOW + IMAGES}
    np.savez(target, allow_pickle=False, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
