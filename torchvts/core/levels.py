"""Image values in [0, 1] from which a pixel or an image is black, saturated or dark; each stands here only."""

BLACK = 2.0 / 255.0
"""Image value up to which a channel has no light: cameras cut off what is darker."""

LIT = 0.06
"""Image value from which a channel of the background has light."""

SATURATED = 0.995
"""Image value above which a pixel of one channel is saturated: 254 and 255 of 255."""

BRIGHT = 0.985
"""Image value above which a mean over pixels is saturated: noise spreads what a camera has cut off."""

MOST_SATURATED = 0.5
"""Share of the values of an image, or of a contact, that may be saturated."""

DARK = 0.25
"""An image of less light than this part of the background's shows no skin: 12 bits in a file of 16 give 1/16."""

DARKEST = 0.02
"""Mean of a channel below which a background shows no light."""


def bits_of(most: float) -> str:
    """What an image whose largest value is this was perhaps read as, such as 12 bits in 16; "" where it has all of its range."""
    level = round(65535 * most)
    of_8_bits = abs(255.0 * most - round(255.0 * most)) < 1e-4  # one in 257 of 16 bits, too
    bits = 0 if of_8_bits else next((bits for bits in (10, 12) if 0 < level < 2**bits), 0)
    return f"its largest value is {level} of 65535: {bits} bits stored in 16? or no light" if bits and most > 0.5 * BLACK else ""
