"""Open this asset in Blender 4 or later: surface, environment, lamps and cameras, Z up.

    blender --python open_in_blender.py
    blender --background --python open_in_blender.py -- --camera 003 --render 003.exr --samples 256
    blender --background --python open_in_blender.py -- --camera 003 --render 003.png --percent 50
    blender --background --python open_in_blender.py -- --save asset.blend

With the package bpy instead of the Blender program: `python open_in_blender.py --render 003.exr`.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

HERE = Path(__file__).resolve().parent
# Width of the sensor, mm. Only its ratio to the focal length matters.
SENSOR = 36.0


def main(arguments):
    parser = argparse.ArgumentParser(
        prog="open_in_blender.py", description="Open an exported asset in Blender."
    )
    parser.add_argument("--camera", help="name of a view (default: the first one)")
    parser.add_argument("--render", type=Path, help="render to this file: .exr (linear) or .png")
    parser.add_argument("--samples", type=int, default=128, help="samples per pixel")
    parser.add_argument("--percent", type=int, default=100, help="size of the image in percent of the view")
    parser.add_argument(
        "--source", choices=["glb", "usd"], default="glb", help="file from which the surface is read"
    )
    parser.add_argument("--save", type=Path, help="save as this .blend file")
    options = parser.parse_args(arguments)
    contents = json.loads((HERE / "scene.json").read_text())
    names = [camera["name"] for camera in contents["cameras"]]
    if options.camera not in [None, *names]:
        parser.error(f"no camera {options.camera!r}; there are {', '.join(names)}")

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = options.samples
    scene.view_settings.view_transform = "Standard"
    add_surface(options.source)
    add_environment(scene, contents["environment"])
    for number, lamp in enumerate(contents["lamps"]):
        add_lamp(scene, f"lamp {number}", lamp)
    for camera in contents["cameras"]:
        add_camera(scene, camera)
    name = options.camera or names[0]
    look_through(scene, next(camera for camera in contents["cameras"] if camera["name"] == name))
    scene.render.resolution_percentage = options.percent
    if options.save:
        bpy.ops.wm.save_as_mainfile(filepath=str(options.save.resolve()))
    if options.render:
        png = options.render.suffix.lower() == ".png"
        scene.render.image_settings.file_format = "PNG" if png else "OPEN_EXR"
        scene.render.image_settings.color_depth = "8" if png else "32"
        scene.render.filepath = str(options.render.resolve())
        bpy.ops.render.render(write_still=True)


def add_surface(source):
    """Import the surface without the lights of the file.

    glTF lights have no radius and cannot be panels; `add_lamp` adds the lamps with both.
    """
    if source == "usd":
        bpy.ops.wm.usd_import(filepath=str(HERE / "asset.usda"))
    else:
        bpy.ops.import_scene.gltf(filepath=str(HERE / "asset.glb"))
    for light in [item for item in bpy.data.objects if item.type == "LIGHT"]:
        bpy.data.objects.remove(light)
    # The material was estimated with single scattering. Blender's default also adds the energy that single
    # scattering loses, up to half on rough metal.
    for material in bpy.data.materials:
        for node in material.node_tree.nodes:
            if node.type == "BSDF_PRINCIPLED":
                node.distribution = "GGX"


def add_environment(scene, maps):
    scene.world = bpy.data.worlds.new("environment")
    # From Blender 5 on, worlds always use nodes.
    if bpy.app.version < (5, 0):
        scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    background = next(node for node in nodes if node.type == "BACKGROUND")
    if maps is None:
        background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
        return
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(str(HERE / maps["blender"]))
    links.new(picture.outputs["Color"], background.inputs["Color"])


def add_lamp(scene, name, lamp):
    """Add a lamp with intensity I: a bulb emits 4π I watts, a panel emits π I watts to one side."""
    panel, brightest = lamp["axis"] is not None, max(lamp["intensity"])
    light = bpy.data.lights.new(name, "AREA" if panel else "POINT")
    light.energy = (math.pi if panel else 4.0 * math.pi) * brightest
    light.color = [channel / brightest for channel in lamp["intensity"]] if brightest > 0 else (1.0, 1.0, 1.0)
    item = bpy.data.objects.new(name, light)
    item.location = lamp["position"]
    if panel:
        light.shape = "DISK"
        light.size = 2.0 * lamp["radius"]
        item.rotation_mode = "QUATERNION"
        item.rotation_quaternion = Vector(lamp["axis"]).to_track_quat("-Z", "Y")
    else:
        light.shadow_soft_size = lamp["radius"]
    scene.collection.objects.link(item)


def add_camera(scene, camera):
    """Add a camera without lens distortion.

    Blender's cameras look along −Z with Y up; their shifts are in units of the width of the image.
    """
    lens = bpy.data.cameras.new(camera["name"])
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = SENSOR
    lens.lens = camera["fx"] / camera["width"] * SENSOR
    lens.shift_x = (0.5 * camera["width"] - camera["cx"]) / camera["width"]
    lens.shift_y = (camera["cy"] - 0.5 * camera["height"]) / camera["width"] * camera["fx"] / camera["fy"]
    lens.clip_start, lens.clip_end = 1e-3, 1e5
    item = bpy.data.objects.new(camera["name"], lens)
    item.matrix_world = Matrix(camera["camera_to_world"]) @ Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
    scene.collection.objects.link(item)


def look_through(scene, camera):
    """Make a camera the active one, and set the size of the image and the aspect ratio of its pixels."""
    scene.camera = scene.objects[camera["name"]]
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    aspect = camera["fx"] / camera["fy"]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1.0, 1.0 / aspect), max(1.0, aspect)


if __name__ == "__main__":
    # In Blender, only the arguments after "--" are for the script.
    if "--" in sys.argv:
        main(sys.argv[sys.argv.index("--") + 1 :])
    elif "--python" in sys.argv or "-P" in sys.argv:
        main([])
    else:
        main(sys.argv[1:])
