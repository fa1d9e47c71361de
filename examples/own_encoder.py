"""Maps with encoders of your own: whatever embeds patches, crops and texts in one space. Here the space is colour."""

import numpy as np

from fus3dmaps_core import Config, Pipeline
from fus3dmaps_core.encoders.protocols import EncoderTrio, PatchEmbeddings
from fus3dmaps_core.segmenters.registry import load_segmenter
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom

COLORS = {"green": (60, 120, 60), "blue": (50, 80, 160), "brown": (120, 90, 60), "white": (225, 220, 210)}


def embed(rgb):  # (..., 3) colours to (..., 4) unit vectors: how near they are to the named ones.
    near = np.exp(-np.linalg.norm(rgb[..., None, :] - np.array([*COLORS.values()], float), axis=-1) / 60)
    return (near / np.linalg.norm(near, axis=-1, keepdims=True)).astype(np.float32)


class ColorEncoder:
    space = "colors"

    def grid(self, height, width):
        return height // 16, width // 16

    def encode_patches(self, rgb):
        means = rgb.reshape(-1, 16, rgb.shape[1] // 16, 16, 3).mean(axis=(1, 3))
        return PatchEmbeddings(embed(means), np.ones(means.shape[:2], np.float32))

    def encode_crops(self, rgb, masks):
        return embed(np.array([rgb[mask].mean(axis=0) for mask in masks.masks]))

    def encode_text(self, prompts):
        return embed(np.array([COLORS[prompt] for prompt in prompts], float))


encoder = ColorEncoder()
trio = EncoderTrio("colors", len(COLORS), 1.0, 20.0, patch=encoder, crop=encoder, text=encoder)
pipeline = Pipeline(Config(), trio, load_segmenter("lite", Config().encoder))
for frame in FurnishedRoom(frames=8):
    pipeline.process(frame)
print(pipeline.ask("brown", top_k=3))
