"""Heads that imitate a teacher's embedding."""

from torch import nn


class Head(nn.Module):
    def __init__(self, wide_in, hidden, wide_out, inner):
        super().__init__()
        self.fc1 = nn.Linear(wide_in, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(hidden), nn.GELU(), nn.Linear(hidden, hidden)) for _ in range(inner)
        )
        self.final = nn.Sequential(nn.LayerNorm(hidden), nn.GELU(), nn.Linear(hidden, wide_out))

    def forward(self, features):
        features = self.fc1(features)
        for block in self.blocks:
            features = features + block(features)
        return self.final(features)


def create_mlp_from_config(version, input_dim, hidden_dim, output_dim, num_inner):
    assert version == "v2"
    return Head(input_dim, hidden_dim, output_dim, num_inner)


def create_mlp_from_state(version, state, prefix="", spectral_weights=False):
    assert version == "v2"
    assert not spectral_weights
    state = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    hidden, wide_in = state["fc1.weight"].shape
    inner = sum(name.endswith(".0.weight") and name.startswith("blocks.") for name in state)
    head = Head(wide_in, hidden, state["final.2.weight"].shape[0], inner)
    head.load_state_dict(state)
    return head
