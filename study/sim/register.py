"""Registers the town with gymnasium when it is imported: `gym.make("study.sim.register:study/Town-v0")`."""

import gymnasium as gym

gym.register("study/Town-v0", entry_point="study.sim.env:TownEnv")
