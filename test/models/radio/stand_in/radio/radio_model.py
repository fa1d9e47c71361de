"""A vision transformer of timm's behind an embedding of patches of any count, after summary tokens and registers."""

import timm
import torch
from torch import nn
from torch.nn import functional


class Tokens(nn.Module):
    def __init__(self, count, width):
        super().__init__()
        self.token = nn.Parameter(torch.randn(count, width) * width**-0.5)


class PatchGenerator(nn.Module):
    def __init__(self, patch_px, width, side, prefix):
        super().__init__()
        self.patch_px, self.side = patch_px, side
        self.embedder = nn.Linear(3 * patch_px**2, width, bias=False)
        self.pos_embed = nn.Parameter(torch.randn(1, side**2, width) * width**-0.5)
        self.cls_token = Tokens(prefix, width)

    def forward(self, images):
        rows, columns = (size // self.patch_px for size in images.shape[2:])
        patches = self.embedder(functional.unfold(images, self.patch_px, stride=self.patch_px).transpose(1, 2))
        places = self.pos_embed.reshape(1, self.side, self.side, -1).permute(0, 3, 1, 2)
        longest = max(rows, columns)
        places = functional.interpolate(places, (longest, longest), mode="bilinear")[..., :rows, :columns]
        prefix = self.cls_token.token.expand(len(images), -1, -1)
        return torch.cat([prefix, patches + places.flatten(2).transpose(1, 2)], dim=1)


class Conditioner(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("norm_mean", torch.zeros(3, 1, 1))
        self.register_buffer("norm_std", torch.ones(3, 1, 1))

    def forward(self, images):
        return (images - self.norm_mean) / self.norm_std


class FeatureNormalizer(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("tx", torch.eye(width))

    def forward(self, features):
        return (features - self.mean) @ self.tx.T


class RADIOModel(nn.Module):
    def __init__(self, model, feature_normalizer):
        super().__init__()
        self.model, self.input_conditioner, self.feature_normalizer = model, Conditioner(), feature_normalizer
        self.num_summary_tokens, self.patch_size = model.num_summary_tokens, model.patch_generator.patch_px
        self.summary_tokens = model.summary_tokens

    def forward(self, images):
        tokens = self.model.patch_generator(self.input_conditioner(images))
        tokens = self.model.norm(self.model.blocks(tokens))
        return tokens[:, self.summary_tokens].flatten(1), self.feature_normalizer(tokens[:, self.num_summary_tokens :])


def create_model_from_args(args):
    vit = timm.create_model(args.model, num_classes=0, weight_init="skip", **args.model_kwargs)
    summaries = len({teacher["name"] for teacher in args.teachers})
    prefix = summaries + args.register_multiple - summaries % args.register_multiple
    patch_px = vit.patch_embed.patch_size[0]
    vit.patch_generator = PatchGenerator(patch_px, vit.embed_dim, args.cpe_max_size // patch_px, prefix)
    vit.num_summary_tokens = prefix
    vit.summary_tokens = [place for place, teacher in enumerate(args.teachers) if teacher["use_summary"]]
    vit.patch_embed = vit.cls_token = vit.pos_embed = None
    vit.head = nn.Identity()
    if not getattr(args, "model_norm", False):
        vit.norm = nn.Identity()
    return vit
