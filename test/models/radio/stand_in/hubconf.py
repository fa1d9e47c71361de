"""Stand-in for the entry point of RADIO's code."""

import torch
from radio.radio_model import FeatureNormalizer, RADIOModel, create_model_from_args
from torch import nn


def radio_model(version, progress=True, return_checkpoint=False):
    checkpoint = torch.load(version, map_location="cpu", weights_only=False)
    state, parts = checkpoint["state_dict"], {"base_model.": {}, "input_conditioner.": {}, "_feature_normalizer.": {}}
    for name, value in state.items():
        for prefix, part in parts.items():
            if name.startswith(prefix):
                part[name.removeprefix(prefix)] = value
    normalizer = nn.Identity()
    if parts["_feature_normalizer."]:
        normalizer = FeatureNormalizer(len(parts["_feature_normalizer."]["mean"]))
        normalizer.load_state_dict(parts["_feature_normalizer."])
    radio = RADIOModel(create_model_from_args(checkpoint["args"]), normalizer)
    radio.model.load_state_dict(parts["base_model."], strict=False)
    radio.input_conditioner.load_state_dict(parts["input_conditioner."])
    return (radio, checkpoint) if return_checkpoint else radio
