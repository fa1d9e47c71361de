"""SigLIP 2 checkpoints with random weights, written as its authors publish theirs, and a tokenizer with a few words."""

from __future__ import annotations

from pathlib import Path

import torch
from tokenizers import Tokenizer, models, pre_tokenizers

from fus3dmaps_core.encoders.siglip_text import TextTower

WORDS = "a an the of in red blue photo square cup game video itap bad origami large small art"


def random_model(size_px: int, text: TextTower) -> torch.nn.Module:
    """Make the package's own model of both towers, the image tower at full width, the text tower as described."""
    from transformers import SiglipConfig, SiglipModel, SiglipTextConfig

    described = SiglipTextConfig(
        vocab_size=text.vocabulary,
        hidden_size=text.width,
        intermediate_size=text.hidden,
        num_hidden_layers=text.layers,
        num_attention_heads=text.heads,
        projection_size=text.dimension,
    )
    config = SiglipConfig(text_config=described.to_dict(), vision_config={"image_size": size_px})
    with torch.device("meta"):
        model = SiglipModel(config).eval().requires_grad_(False)
    model.to_empty(device="cpu")
    for embeddings in (model.text_model.embeddings, model.vision_model.embeddings):
        embeddings.position_ids = torch.arange(embeddings.position_embedding.num_embeddings)[None]
    for name, weight in model.named_parameters():  # Biases of zero and narrow weights would hide what is left out.
        torch.nn.init.normal_(weight, mean=1.0 if "norm" in name and name.endswith("weight") else 0.0, std=0.05)
    return model


def published_state(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Return its weights under the names of the published file, which have no shells around the towers."""
    return {
        name.replace("text_model.text_model.", "text_model.").replace(
            "vision_model.vision_model.", "vision_model."
        ): value.contiguous()
        for name, value in model.state_dict().items()
    }


def write_directory(folder: Path, model: torch.nn.Module) -> Path:
    """Write weights of one's own for `encoder.weights`; under the published file's name they would need its hash."""
    torch.save(published_state(model), folder / "model.pt")
    write_tokenizer(folder / "tokenizer.json")
    return folder


def write_tokenizer(path: Path) -> Path:
    """Write a tokenizer of whole words whose first three are padding, end and the unknown word."""
    words = {word: place for place, word in enumerate(["<pad>", "<eos>", "<unk>", *WORDS.split()])}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.save(str(path))
    return path
