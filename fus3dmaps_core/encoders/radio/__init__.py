"""Encoder trios on RADIO, NVIDIA's vision model that imitates many teachers: ``naradio`` and ``radseg``.

``encoder.weights`` may be empty: code, weights and text tower then come from where they are published, see
:mod:`fus3dmaps_core.encoders.radio.published`. Without a network it is a directory with

- ``RADIO/``: a checkout of RADIO's code at the revision named there; it may lie in the cache of ``torch.hub`` instead;
- the checkpoint, under its published name, e.g. ``radio-v2.5-l_half.pth.tar``;
- ``model.safetensors`` and ``tokenizer.json``: the text tower's, which differ between the two trios.
"""
