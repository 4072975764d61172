"""Render this asset with Mitsuba 3: surface, environment, lamps and cameras, in the capture's world (Z up).

    python open_in_mitsuba.py 003.exr --camera 003 --samples 256

As a module: `scene(camera)` returns the dictionary for `mitsuba.load_dict`. Set a variant first, for example
with `mitsuba.set_variant("llvm_ad_rgb")`.
"""

import argparse
import json
import math
from pathlib import Path

import mitsuba as mi

HERE = Path(__file__).resolve().parent


def main():
    parser = argparse.ArgumentParser(
        prog="open_in_mitsuba.py", description="Render an exported asset with Mitsuba 3."
    )
    parser.add_argument("out", type=Path, help="EXR file to write (linear)")
    parser.add_argument("--camera", help="name of a view (default: the first one)")
    parser.add_argument("--samples", type=int, default=128, help="samples per pixel")
    parser.add_argument("--variant", default="scalar_rgb", help="variant of Mitsuba")
    options = parser.parse_args()
    names = [camera["name"] for camera in read_scene_file()["cameras"]]
    if options.camera not in [None, *names]:
        parser.error(f"no camera {options.camera!r}; there are {', '.join(names)}")
    mi.set_variant(options.variant)
    image = mi.render(mi.load_dict(scene(options.camera or names[0])), spp=options.samples)
    mi.Bitmap(image).write(str(options.out))


def read_scene_file():
    return json.loads((HERE / "scene.json").read_text())


def scene(camera):
    """Return the scene with the camera of the given name."""
    contents = read_scene_file()
    parts = {"type": "scene", "integrator": {"type": "path", "max_depth": 8}, "surface": surface()}
    if contents["environment"]:
        # Mitsuba's layout of environment maps is the same, but its up axis is Y.
        y_to_z = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        parts["environment"] = {
            "type": "envmap",
            "filename": str(HERE / contents["environment"]["ours"]),
            "to_world": y_to_z,
        }
    for number, lamp in enumerate(contents["lamps"]):
        parts[f"lamp_{number}"] = lamp_shape(lamp)
    parts["sensor"] = sensor(next(view for view in contents["cameras"] if view["name"] == camera))
    return parts


def surface():
    bsdf = {
        "type": "principled",
        "base_color": {"type": "bitmap", "filename": texture("base_color")},
        "roughness": {"type": "bitmap", "filename": texture("roughness"), "raw": True},
        "metallic": {"type": "bitmap", "filename": texture("metallic"), "raw": True},
    }
    normals = {"type": "bitmap", "filename": texture("normal"), "raw": True}
    normal_mapped = {"type": "normalmap", "normalmap": normals, "bsdf": bsdf}
    # The surface is open at parts that no camera sees, so its inside can be visible.
    return {
        "type": "ply",
        "filename": str(HERE / "mesh.ply"),
        "flip_tex_coords": True,
        "bsdf": {"type": "twosided", "nested": normal_mapped},
    }


def texture(name):
    return str(HERE / "textures" / f"{name}.png")


def lamp_shape(lamp):
    """Return a bulb as a sphere or a panel as a disk, with constant radiance."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": lamp["radiance"]}}
    if lamp["axis"] is None:
        return {"type": "sphere", "center": lamp["position"], "radius": lamp["radius"], "emitter": emitter}
    position, axis = lamp["position"], lamp["axis"]
    up = [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0]
    target = [p + a for p, a in zip(position, axis, strict=True)]
    pose = mi.ScalarTransform4f().look_at(position, target, up).scale(lamp["radius"])
    return {"type": "disk", "to_world": pose, "emitter": emitter}


def sensor(camera):
    """Return a camera without lens distortion. Mitsuba's cameras have x to the left and y up.

    Mitsuba's pixels are square. If those of the capture are not, the number of rows is changed so that the
    field of view stays the same.
    """
    flip = mi.ScalarTransform4f().scale([-1, -1, 1])
    width, height = camera["width"], round(camera["height"] * camera["fx"] / camera["fy"])
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2.0 * math.atan(0.5 * width / camera["fx"])),
        "principal_point_offset_x": 0.5 - camera["cx"] / width,
        "principal_point_offset_y": 0.5 - camera["cy"] / camera["height"],
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(camera["camera_to_world"]) @ flip,
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
    }


if __name__ == "__main__":
    main()
