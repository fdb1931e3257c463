"""What the tests ask lerobot: it reads a data set and prints what it found as JSON.

Run by a Python that has lerobot, which needs PyTorch; nothing of wepose_pin is imported here.
"""

from __future__ import annotations

import json
import os
import sys

os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def read(root: str) -> dict[str, object]:
    """All frames, the episodes and their tasks, statistics, and what a model that looks ahead gets."""
    data = LeRobotDataset("wepose/test", root=root)
    frames = [data[k] for k in range(len(data))]
    fps = data.fps
    ahead = LeRobotDataset("wepose/test", root=root, delta_timestamps={"action": [0.0, 1 / fps, 2 / fps]})
    second = LeRobotDataset("wepose/test", root=root, episodes=[data.num_episodes - 1])
    batch = next(iter(torch.utils.data.DataLoader(ahead, batch_size=8)))
    return {
        "fps": fps,
        "robot": data.meta.robot_type,
        "joints": data.meta.names["action"],
        "episodes": data.num_episodes,
        "lengths": list(data.meta.episodes["length"]),
        "frames": len(data),
        "state": np.stack([frame["observation.state"].numpy() for frame in frames]).tolist(),
        "action": np.stack([frame["action"].numpy() for frame in frames]).tolist(),
        "tasks": [frame["task"] for frame in frames],
        "mean": data.meta.stats["action"]["mean"].tolist(),
        "ahead": list(batch["action"].shape),
        "next_actions": ahead[0]["action"].tolist(),
        "last_episode": len(second),
        "dtype": str(frames[0]["action"].dtype),
    }


if __name__ == "__main__":
    json.dump(read(sys.argv[1]), sys.stdout)
