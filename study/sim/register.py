"""Registers our environments with gymnasium when it is imported: `gym.make("study.sim.register:study/Town-v0")`.

Since its version 1.0 gymnasium looks for no plugins: the module before the colon is what it imports by itself.
"""

import gymnasium as gym

gym.register("study/Town-v0", entry_point="study.sim.env:TownEnv")
gym.register("study/BirdviewTown-v0", entry_point="study.environments:BirdviewTownEnv")
gym.register("study/LatentTown-v0", entry_point="study.environments:latent_town")
