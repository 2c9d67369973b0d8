"""Write ``torchrg/render/font.png``, the glyphs of the legends of images.

The font is Aileron by Sora Sagano (CC0, in the public domain), which Pillow contains. The first row
of the image marks the first column of each glyph.
"""

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

GLYPHS = "".join(map(chr, range(32, 127))) + "²"
"""Characters in the order of the image: printable ASCII, and the exponent of areas."""
SIZE = 21
"""Font size in pixels, readable in an image of 1,400 pixels on a page."""
FONT = Path(__file__).parents[1] / "torchrg" / "render" / "font.png"


def main() -> None:
    """Draw one glyph after the other."""
    font = ImageFont.load_default(SIZE)
    widths = [max(1, round(font.getlength(glyph))) for glyph in GLYPHS]
    ascent, descent = font.getmetrics()
    image = Image.new("L", (sum(widths), ascent + descent + 1))
    draw, left = ImageDraw.Draw(image), 0
    for glyph, width in zip(GLYPHS, widths, strict=True):
        if glyph == "²":  # Not in the font.
            glyph, font = "2", ImageFont.load_default(round(0.62 * SIZE))
        draw.text((left, 1), glyph, fill=255, font=font)
        image.putpixel((left, 0), 255)
        left += width
    image.save(FONT, optimize=True)


if __name__ == "__main__":
    main()
