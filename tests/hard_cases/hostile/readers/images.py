"""Images: what cameras and renderers write, and environment maps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import tifffile
from PIL import Image

from neilfpp_method.data.brackets.photo_exposure import photo_exposure
from neilfpp_method.data.files.environment_map import read_environment
from neilfpp_method.data.files.images import image_header, read_image, write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.photos import survey
from tests.hard_cases.hostile.readers.reader import Reader, picture

__all__ = ["IMAGES"]


def _exr(folder: Path) -> list[Path]:
    rgb = picture(3)
    write_exr(folder / "plain.exr", {"RGBA": picture(4)})
    write_exr(folder / "half.exr", {"RGB": rgb.astype(np.float16), "depth": picture(1)[..., 0]})
    packings = {
        "none": OpenEXR.NO_COMPRESSION,
        "rle": OpenEXR.RLE_COMPRESSION,
        "piz": OpenEXR.PIZ_COMPRESSION,
        "pxr24": OpenEXR.PXR24_COMPRESSION,
        "b44": OpenEXR.B44_COMPRESSION,
        "dwaa": OpenEXR.DWAA_COMPRESSION,
    }
    for name, packing in packings.items():
        header = {"compression": packing, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": rgb.astype(np.float16)}).write(str(folder / f"{name}.exr"))
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    OpenEXR.File({"type": OpenEXR.tiledimage, "tiles": tiles}, {"RGB": rgb}).write(str(folder / "tiles.exr"))
    parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": rgb}, name) for name in ("one", "other")]
    OpenEXR.File(parts).write(str(folder / "parts.exr"))
    return sorted(folder.iterdir())


def _png(folder: Path) -> list[Path]:
    write_png(folder / "rgb.png", picture(3, np.uint8))
    write_png(folder / "rgba16.png", picture(4, np.uint16))
    write_png(folder / "grey.png", picture(1, np.uint8))
    image = Image.fromarray(picture(3, np.uint8))
    image.quantize(16).save(folder / "palette.png")
    image.convert("1").save(folder / "bits.png")
    image.convert("LA").save(folder / "grey-alpha.png")
    return sorted(folder.iterdir())


def _tiff(folder: Path) -> list[Path]:
    tifffile.imwrite(folder / "u8.tif", picture(3, np.uint8), photometric="rgb")
    tifffile.imwrite(folder / "u16.tif", picture(3, np.uint16), photometric="rgb", byteorder=">")
    tifffile.imwrite(folder / "float.tif", picture(3), photometric="rgb")
    tifffile.imwrite(folder / "half.tif", picture(1, np.float16)[..., 0])
    tifffile.imwrite(
        folder / "planes.tif", np.moveaxis(picture(3), -1, 0), photometric="rgb", planarconfig="separate"
    )
    tifffile.imwrite(folder / "tiles.tif", picture(3), photometric="rgb", tile=(16, 16))
    for name in ("tiff_lzw", "tiff_deflate", "packbits", "jpeg"):
        Image.fromarray(picture(3, np.uint8)).save(folder / f"{name}.tif", compression=name)
    return sorted(folder.iterdir())


def _jpeg(folder: Path) -> list[Path]:
    image = Image.fromarray(picture(3, np.uint8))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x829A] = 0.01
    image.save(folder / "rgb.jpg", exif=exif)
    image.save(folder / "progressive.jpg", progressive=True, subsampling=2)
    image.convert("L").save(folder / "grey.jpg")
    image.convert("CMYK").save(folder / "cmyk.jpg")
    return sorted(folder.iterdir())


def _hdr(folder: Path) -> list[Path]:
    cv2.imwrite(str(folder / "packed.hdr"), picture(3))
    cv2.imwrite(str(folder / "plain.hdr"), picture(3), [cv2.IMWRITE_HDR_COMPRESSION, 0])
    upright = (folder / "packed.hdr").read_bytes()
    (folder / "rotated.hdr").write_bytes(upright.replace(b"-Y", b"-X", 1).replace(b"+X", b"+Y", 1))
    return sorted(folder.iterdir())


def _read_image(folder: Path, damaged: Path) -> None:
    header = image_header(damaged)
    image = read_image(damaged)
    assert image.pixels.dtype == np.float32
    assert image.pixels.shape[:2] == (header.height, header.width)
    assert image.pixels.shape[2] in (1, 3)
    if not header.hdr:
        assert (image.pixels >= 0).all()
        assert (image.pixels <= 1).all()


def _read_photo(folder: Path, damaged: Path) -> None:
    exposure = photo_exposure(damaged)
    assert exposure is None or (np.isfinite(exposure) and exposure > 0)
    _read_image(folder, damaged)


def _photographs(folder: Path) -> list[Path]:
    """Photographs with EXIF; a RAW file of most cameras is a TIFF file."""
    image = Image.fromarray(picture(3, np.uint8))
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "maker", "model", 6
    exif.get_ifd(0x8769).update({0x829A: 0.01, 0x829D: 5.6, 0x8827: 200, 0x920A: 35.0, 0xA405: 50})
    for name in ("a.jpg", "b.png", "c.tif"):
        image.save(folder / name, exif=exif)
    (folder / "d.dng").write_bytes((folder / "c.tif").read_bytes())
    return sorted(folder.iterdir())


def _read_photographs(folder: Path, damaged: Path) -> None:
    photos = survey(folder, "linear")
    for photo in photos.items:
        for number in (photo.exposure, photo.focal):
            assert number is None or (np.isfinite(number) and number > 0)
    for problem in photos.unreadable.values():
        raise UserError(problem, "export it again")


def _environment(folder: Path) -> list[Path]:
    write_exr(folder / "map.exr", {"RGB": picture(3)})
    return [folder / "map.exr"]


def _read_environment(folder: Path, damaged: Path) -> None:
    radiance = read_environment(damaged)
    assert radiance.isfinite().all()
    assert radiance.amin() >= 0


IMAGES: Mapping[str, Reader] = {
    "EXR": Reader(_exr, _read_image),
    "PNG": Reader(_png, _read_image),
    "TIFF": Reader(_tiff, _read_image),
    "JPEG": Reader(_jpeg, _read_photo),
    "HDR": Reader(_hdr, _read_image),
    "photographs (EXIF)": Reader(_photographs, _read_photographs, 0.2),
    "environment map": Reader(_environment, _read_environment),
}
