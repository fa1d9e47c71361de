"""Stand-in for the entry point of RADIO's code."""

import torch
from radio.radio_model import RADIOModel, create_model_from_args


def radio_model(version, progress=True, return_checkpoint=False):
    checkpoint = torch.load(version, map_location="cpu", weights_only=False)
    state, parts = checkpoint["state_dict"], {"base_model.": {}, "input_conditioner.": {}}
    for name, value in state.items():
        for prefix, part in parts.items():
            if name.startswith(prefix):
                part[name.removeprefix(prefix)] = value
    radio = RADIOModel(create_model_from_args(checkpoint["args"]))
    radio.model.load_state_dict(parts["base_model."], strict=False)
    radio.input_conditioner.load_state_dict(parts["input_conditioner."])
    return (radio, checkpoint) if return_checkpoint else radio
