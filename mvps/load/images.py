"""PNG files -> linear code values, refusing everything that is not a whole, honest photograph.

A PNG is a signature and a chain of chunks (length, type, data, CRC of type and data; ISO/IEC 15948, section 5). The chain is
walked before anything is decoded: decoders fill the missing rows of a truncated file with black without a word, and black is
data here. The size in the header is checked before memory is asked for.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.inputs import read_file
from mvps.scene import Bool, CaptureError, Int

SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER_BYTES = 33
"""Signature (8) and the IHDR chunk (4 length, 4 type, 13 data, 4 CRC)."""

PIXEL_LIMIT = 100_000_000
"""Most pixels of an image: no camera used for photometric stereo makes more, and one such image decodes to 0.6 GB."""


FILE_LIMIT = 1 << 30
"""Most bytes of a file that is read whole: PIXEL_LIMIT pixels that do not compress take less."""

TEXT_LIMIT = 1 << 20
"""Most bytes of a text: names or numbers of ten thousand lights take less."""

UNCHECKED_BYTES = 1 << 24
"""Decoded bytes that any file may ask for: the decoder holds them twice, for each of two cores."""

MOST_PACKED = 100
"""Largest ratio of a larger photograph to its file. Noise does not compress: where the object covers a twelfth of the picture and two of
sixteen bits are noise, the file has a hundredth of the bytes. A thousandth is a picture of nothing, made to fill the memory."""

MASK_LIMIT = 150_000_000
"""Most decoded bytes of a mask, which may compress a thousandfold: 100 megapixels of 8-bit grey are fewer."""

CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Decoded, by the colour type of a PNG (ISO/IEC 15948, 11.2.2)."""


class Header(NamedTuple):
    """What a PNG says about itself: height, width in pixels; bits per stored code value, 8 or 16; colour type."""

    height: int
    width: int
    bits: int
    colour: int = 2

    @property
    def decoded(self) -> int:
        """Bytes of the picture in memory."""
        return self.height * self.width * CHANNELS.get(self.colour, 4) * self.bits // 8


def complaint(path: Path, wanted: str, given: str, advice: str) -> CaptureError:
    """The one form of every complaint about a capture: where, wanted, given, what to try."""
    return CaptureError(f"{path}: wanted {wanted}, given {given}; {advice}")


def read_bytes(path: Path, wanted: str, advice: str, first: int = -1, most: int = FILE_LIMIT) -> bytes:
    """The file's first bytes (-1: all of them, `most` at most), or a CaptureError that says why not."""
    try:
        data = read_file(path, most, first)
    except FileNotFoundError:
        raise complaint(path, wanted, "no such file", advice) from None
    except OSError as error:
        raise complaint(path, wanted, f"a file that cannot be read ({error.strerror})", "check its type and permissions") from None
    if not data:
        raise complaint(path, wanted, "an empty file of 0 bytes", "copy or export it again")
    return data


def read_header(path: Path, wanted: str = "a photograph as PNG") -> Header:
    """Height, width and bits of a PNG, from its first 33 bytes; CaptureError where it is none or larger than PIXEL_LIMIT."""
    data = read_bytes(path, wanted, "restore the file or correct the file's name", HEADER_BYTES)
    if not data.startswith(SIGNATURE[: len(data)]):
        raise complaint(path, wanted, f"a file that starts with {data[:8]!r}", "save it as PNG")
    if len(data) < HEADER_BYTES or data[12:16] != b"IHDR":
        raise complaint(path, wanted, f"a PNG without its header, {len(data)} bytes read", "copy or export it again")
    width, height = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
    if width < 1 or height < 1 or width * height > PIXEL_LIMIT:
        raise complaint(path, f"1 to {PIXEL_LIMIT // 1_000_000} megapixels", f"{width} x {height} pixels", "scale or crop the photographs")
    colour, bits = data[25], data[24]
    if colour not in CHANNELS or bits not in (1, 2, 4, 8, 16):
        raise complaint(path, wanted, f"a PNG of colour type {colour} and {bits} bits, which there is not", "export it again")
    return Header(height, width, 16 if bits == 16 else 8, colour)


def check_packing(path: Path, header: Header) -> None:
    """CaptureError where a photograph would take far more memory than its file can hold a picture for."""
    size = os.stat(path).st_size
    if header.decoded > max(UNCHECKED_BYTES, MOST_PACKED * size):
        given = f"{header.width} x {header.height} pixels in {size} bytes, a {header.decoded // size}th of what they decode to"
        raise complaint(path, f"a photograph, of which a file holds a {MOST_PACKED}th at least", given, "export or crop it again")


def _fault(data: bytes) -> str:
    """What is wrong with the chunks of a PNG; empty where it is whole."""
    position, end = len(SIGNATURE), len(data)
    while position + 12 <= end:
        length = int.from_bytes(data[position : position + 4], "big")
        stop = position + 12 + length
        if stop > end:
            break
        kind = data[position + 4 : position + 8]
        if zlib.crc32(memoryview(data)[position + 4 : stop - 4]) != int.from_bytes(data[stop - 4 : stop], "big"):
            return f"a damaged PNG (wrong checksum of the block at byte {position})"
        if kind == b"IEND":
            return ""
        position = stop
    return f"a truncated PNG of {end} bytes"


def decode(path: Path, header: Header) -> NDArray[Any]:
    """(height, width, 3) RGB code values, uint8 or uint16 as stored; grey is repeated thrice, transparency dropped."""
    return _colours(_decoded(path, header, "a photograph as PNG"))


def read_painting(path: Path, height: int, width: int) -> NDArray[np.float32]:
    """(height, width, 4) red, green, blue and opacity of a painted picture of this size, code values over full scale."""
    wanted = f"a painted picture as PNG, {width} x {height} pixels"
    header = read_header(path, wanted)
    # Before it is decoded: what is mostly clear packs as well as what is made to fill the memory.
    if header[:2] != (height, width):
        raise complaint(path, wanted, f"{header.width} x {header.height}", "paint over a picture of that view")
    image = _decoded(path, header, wanted)
    full = np.float32(65535 if header.bits == 16 else 255)
    opacity = image[..., 3:] if image.shape[2] == 4 else np.full((*header[:2], 1), full)
    painted: NDArray[np.float32] = np.concatenate([_colours(image), opacity], 2).astype(np.float32) / full
    return painted


def _colours(image: NDArray[Any]) -> NDArray[Any]:
    """(height, width, 3) red, green, blue of what `_decoded` gives."""
    return np.broadcast_to(image, (*image.shape[:2], 3)) if image.shape[2] == 1 else image[..., 2::-1]


def _decoded(path: Path, header: Header, wanted: str) -> NDArray[Any]:
    """(height, width, channels) as the decoder orders them: grey, or blue, green, red and perhaps opacity."""
    data = read_bytes(path, wanted, "restore the file or correct the file's name")
    fault = _fault(data)
    if fault:
        raise complaint(path, wanted, fault, "copy or export it again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != header[:2] or image.dtype != (np.uint16 if header.bits == 16 else np.uint8):
        raise complaint(path, wanted, "a PNG that cannot be decoded", "export it again")
    found: NDArray[Any] = image[..., None] if image.ndim == 2 else image
    return found


def read_mask(path: Path) -> Bool:
    """(height, width) True where any channel is above half of full scale (127 of 255); never all True or all False."""
    wanted = "a mask of the object as PNG, white on black"
    header = read_header(path, wanted)
    if header.decoded > MASK_LIMIT:
        raise complaint(
            path, wanted, f"one that takes {header.decoded / 1e6:.0f} MB, more than {MASK_LIMIT / 1e6:.0f}", "save it as 8-bit grey"
        )
    values = decode(path, header)
    above, channels = 127 if header.bits == 8 else 32767, 1 if header.colour == 0 else 3
    mask: Bool = values[..., 0] > above
    for channel in range(1, channels):
        mask |= values[..., channel] > above
    if not mask.any():
        raise complaint(path, "some foreground above half of full scale", f"none, largest value {values.max()}", "paint the object white")
    if mask.all():
        raise complaint(path, "some background around the object", "foreground in every pixel", "paint the background black")
    return mask


def histogram(samples: Sequence[NDArray[np.uint16]]) -> Int:
    """(65536,) how many samples hold each code value, in blocks so that memory stays small."""
    counts = np.zeros(65536, np.int64)
    for view in samples:
        flat = view.reshape(-1)
        for start in range(0, len(flat), 1 << 20):
            counts += np.bincount(flat[start : start + (1 << 20)], minlength=65536)
    return counts


STRAY = 0.01
"""Of the samples that are clipped."""


def clip_level(counts: Int) -> int:
    """The code value at and above which 16-bit samples are clipped, from how many samples hold each code (65536,).

    Full scale is the last multiple of the step between codes: a 12-bit sensor stored times 16 ends at 4095 * 16 = 65520.
    The step is the greatest common divisor of all codes, at most 257 (8 bits stretched to 16); a larger one tells of few
    values, not of a sensor, and counts as 1.
    A sensor may also clip below full scale (codes not stretched, a gain after clipping): everything brighter then gathers
    in the largest code. Without clipping the largest code holds no such crowd: the level sets of a smooth bright spot
    have equal areas from code to code, and those along a ridge grow as the square root of the distance to the maximum, so
    the last code holds 1 / (sqrt(2) - 1) = 2.4 times the one before. So the largest code is a clip level where it holds
    more than 4 times what any other code of the top tenth holds, 16 samples added against chance, and that tenth
    holds 8 codes at least, without which there is no tail to compare with. What holds less than STRAY of that beyond it is
    no sensor's (a pixel that was painted in).
    """
    codes = np.flatnonzero(counts)
    if not len(codes) or codes[-1] == 0:
        return 65535
    step = int(np.gcd.reduce(codes))
    full_scale = 65535 // step * step if step <= 257 else 65535
    beyond = counts[codes][::-1].cumsum()[::-1] - counts[codes]
    top = int(codes[beyond <= STRAY * counts[codes]].min())
    tail = codes[(codes >= 0.9 * top) & (codes < top)]
    crowded = len(tail) >= 8 and counts[top] > 4 * counts[tail].max() + 16
    return top if crowded else full_scale
