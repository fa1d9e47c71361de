"""Encoder pairs on RADIO, NVIDIA's vision model with many teachers: ``naradio`` and ``radseg``."""
