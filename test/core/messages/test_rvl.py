"""The RVL decoder against code worked out by hand and a plain encoder; truncated and damaged code is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from reference.depth_codes import rvl

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.messages.rvl import decode_rvl

a_pixel = st.one_of(st.just(0), st.just(0), st.integers(0, 65535), st.integers(1000, 1008))
rows_of_pixels = arrays(np.uint16, st.integers(1, 300), elements=a_pixel)


@pytest.mark.parametrize(
    ("word", "pixels"),
    [
        # 2 zeros, 3 others; +5 folds to 10 (A 1), +0 to 0, -2 to 3.
        (0x23A10300, [0, 0, 5, 5, 3]),
        # 0 zeros, 1 other, +7 folds to 14 (E 1); 2 zeros, 1 other, +1, which spans the zeros, folds to 2.
        (0x01E12120, [7, 0, 0, 8]),
        # 9 zeros (9 1), 0 others.
        (0x91000000, [0] * 9),
        # 0 zeros, 1 other, +65535 folds to 131070, in octal 377776.
        (0x01EFFFF3, [65535]),
    ],
)
def test_code_worked_out_by_hand(word, pixels):
    assert decode_rvl(word.to_bytes(4, "little"), len(pixels)).tolist() == pixels


@given(rows_of_pixels)
def test_what_the_plain_encoder_wrote_comes_back(pixels):
    decoded = decode_rvl(rvl(pixels), len(pixels))
    assert decoded.dtype == np.uint16
    np.testing.assert_array_equal(decoded, pixels)


def test_a_large_image_of_many_runs(rng):
    pixels = rng.integers(500, 4000, 64 * 480).astype(np.uint16)
    pixels[rng.random(len(pixels)) < 0.3] = 0
    np.testing.assert_array_equal(decode_rvl(rvl(pixels), len(pixels)), pixels)


@given(rows_of_pixels, st.data())
def test_every_truncation_is_refused(pixels, data):
    code = rvl(pixels)
    with pytest.raises(FrameError) as caught:
        decode_rvl(code[: data.draw(st.integers(0, len(code) - 1))], len(pixels))
    assert caught.value.reason == "bad_compression"


@given(rows_of_pixels, st.data())
def test_flipped_bits_give_an_image_or_a_refusal(pixels, data):
    code = bytearray(rvl(pixels))
    for _ in range(data.draw(st.integers(1, 4))):
        bit = data.draw(st.integers(0, 8 * len(code) - 1))
        code[bit // 8] ^= 1 << bit % 8
    decode_or_refuse(bytes(code), len(pixels))


@given(st.binary(max_size=400), st.integers(1, 500))
def test_any_bytes_give_an_image_or_a_refusal(code, pixels):
    decode_or_refuse(code, pixels)


@pytest.mark.parametrize(
    ("words", "pixels", "message"),
    [
        ([0x00000000], 4, "run of 0 pixels"),
        ([0x41000000], 4, "run of 5 pixels"),
        ([0x01300000], 1, "readings from -2 to -2"),  # A reading below 1 is none.
        ([0xFFFFFFFF] * 4, 4, "ends after 0 of 4"),  # One number of 32 nibbles.
        ([], 4, "ends after 0 of 4"),
    ],
)
def test_code_that_no_encoder_writes_is_refused(words, pixels, message):
    with pytest.raises(FrameError, match=message) as caught:
        decode_rvl(b"".join(word.to_bytes(4, "little") for word in words), pixels)
    assert caught.value.reason == "bad_compression"


def decode_or_refuse(code: bytes, pixels: int) -> None:
    try:
        outcome = decode_rvl(code, pixels).shape
    except FrameError as error:
        outcome = error.reason
    assert outcome in ("bad_compression", (pixels,))
