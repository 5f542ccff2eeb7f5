"""Ray-traced pictures of a synthetic person: solid textures, lights, antialiasing, in one pass over the pixels.

Textures are functions of a surface point's place in the *template* at rest, relative to the middle of the eyes [m], so
they stick to the moving surface. The pictures are data to fit to: the module has no adjoints.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from mgavatar.kernels.bridge import launch_ranges
from mgavatar.kernels.ray_cast import FAR, RayMesh

wp.set_module_options({"enable_backward": False})

SKIN, EYE, TEETH, MOUTH, CLOTH = (wp.constant(i) for i in range(5))
N_SAMPLES = 16
"""Rays per pixel on a silhouette or an edge of colour; a pixel of one colour takes only the first four."""


@wp.struct
class Look:
    """Colours (linear RGB, 0..1) and patterns of one person."""

    skin: wp.vec3
    lips: wp.vec3
    hair_dark: wp.vec3
    hair_light: wp.vec3
    iris: wp.vec3
    cloth: wp.vec3
    print: wp.vec3
    freckles: float
    stubble: float
    pattern: int  # 0 plain, 1 stripes, 2 checks, 3 dots
    eye_offset: wp.vec3  # left eye's centre from the middle of the eyes [m]
    eye_radius: float  # [m]
    seed: wp.uint32


@wp.struct
class View:
    """A pinhole camera and the rectangle of pixels to fill."""

    origin: wp.vec3
    to_world: wp.mat33
    focal: wp.vec2
    center: wp.vec2
    corner: wp.vec2
    columns: int


@wp.func
def blob(point: wp.vec3, center: wp.vec3, radius: float) -> float:
    """Return 1 at the centre, falling off as a Gaussian; mirrored from the left to the right."""
    offset = (wp.vec3(wp.abs(point[0]), point[1], point[2]) - center) / radius
    return wp.exp(-0.5 * wp.dot(offset, offset))


@wp.func
def step_between(low: float, high: float, x: float) -> float:
    """Return 0 below ``low``, 1 above ``high``, and a smooth cubic between them."""
    t = wp.clamp((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def lattice(x: wp.uint32, y: wp.uint32, z: wp.uint32, seed: wp.uint32) -> float:
    """Hash a lattice point to a number in -1..1."""
    h = x * wp.uint32(73856093) ^ y * wp.uint32(19349663) ^ z * wp.uint32(83492791) ^ seed * wp.uint32(1640531527)
    h = (h ^ (h >> wp.uint32(15))) * wp.uint32(2146121005)
    h = (h ^ (h >> wp.uint32(13))) * wp.uint32(1183186591)
    return float((h ^ (h >> wp.uint32(16))) >> wp.uint32(8)) * (2.0 / 16777216.0) - 1.0


@wp.func
def noise(seed: wp.uint32, point: wp.vec3) -> float:
    """Interpolate random numbers of the integer lattice smoothly (value noise), -1..1; much faster than Perlin's."""
    low = wp.vec3(wp.floor(point[0]), wp.floor(point[1]), wp.floor(point[2]))
    t = point - low
    f = wp.cw_mul(wp.cw_mul(t, t), wp.vec3(3.0, 3.0, 3.0) - 2.0 * t)
    x, y, z = wp.uint32(wp.int32(low[0])), wp.uint32(wp.int32(low[1])), wp.uint32(wp.int32(low[2]))
    one = wp.uint32(1)
    near = wp.lerp(
        wp.lerp(lattice(x, y, z, seed), lattice(x + one, y, z, seed), f[0]),
        wp.lerp(lattice(x, y + one, z, seed), lattice(x + one, y + one, z, seed), f[0]),
        f[1],
    )
    far = wp.lerp(
        wp.lerp(lattice(x, y, z + one, seed), lattice(x + one, y, z + one, seed), f[0]),
        wp.lerp(lattice(x, y + one, z + one, seed), lattice(x + one, y + one, z + one, seed), f[0]),
        f[1],
    )
    return wp.lerp(near, far, f[2])


@wp.func
def noise2(seed: wp.uint32, x: float, y: float) -> float:
    """Interpolate value noise in the plane, -1..1."""
    i, j = wp.floor(x), wp.floor(y)
    s, t = x - i, y - j
    s, t = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
    u, v = wp.uint32(wp.int32(i)), wp.uint32(wp.int32(j))
    one, none = wp.uint32(1), wp.uint32(0)
    low = wp.lerp(lattice(u, v, none, seed), lattice(u + one, v, none, seed), s)
    return wp.lerp(low, wp.lerp(lattice(u, v + one, none, seed), lattice(u + one, v + one, none, seed), s), t)


@wp.func
def spots(point: wp.vec3, cell: float, chance: float, seed: wp.uint32) -> float:
    """Draw round spots, at most one per cell of a grid [m]: 1 inside, 0 outside."""
    grid = point / cell
    corner = wp.vec3(wp.floor(grid[0]), wp.floor(grid[1]), wp.floor(grid[2]))
    x, y, z = wp.uint32(wp.int32(corner[0])), wp.uint32(wp.int32(corner[1])), wp.uint32(wp.int32(corner[2]))
    if 0.5 + 0.5 * lattice(x, y, z, seed) > chance:
        return 0.0
    shift = wp.vec3(lattice(y, z, x, seed), lattice(z, x, y, seed), lattice(z, y, x, seed))
    radius = 0.20 + 0.08 * lattice(y, x, z, seed)
    distance = wp.length(grid - corner - wp.vec3(0.5, 0.5, 0.5) - 0.2 * shift)
    return 1.0 - step_between(0.6 * radius, radius, distance)


@wp.func
def strands(point: wp.vec3, seed: wp.uint32) -> float:
    """Return the brightness of hair, -1..1: noise stretched from the crown outwards, in wavy clumps."""
    arm = point - wp.vec3(0.0, 0.0, -0.075)
    around = wp.atan2(arm[0], arm[2])
    above = wp.atan2(arm[1] - 0.02, wp.length(wp.vec2(arm[0], arm[2])))
    ring = wp.cos(above)
    waves = 0.10 * wp.sin(9.0 * above + 3.0 * noise2(seed, 2.0 * around, 2.0 * above))
    thread = wp.vec3(ring * wp.sin(around + waves), ring * wp.cos(around + waves), 0.06 * above)
    fine = noise(seed, 42.0 * thread + wp.vec3(0.0, 0.0, 3.1))
    coarse = noise(seed, 13.0 * thread)
    return wp.clamp(0.9 * fine + 1.1 * coarse, -1.0, 1.0)


@wp.func
def brow(point: wp.vec3, look: Look) -> float:
    """Return how much of a point eyebrow hairs cover, 0..1: an arc above each eye, made of slanted strokes."""
    x = wp.abs(point[0])
    along = (x - 0.013) / 0.036
    arc = 0.0185 + 0.0075 * wp.sin(1.9 * wp.clamp(along, 0.0, 1.0)) - 0.004 * along
    half = 0.0042 * (1.0 - 0.55 * wp.clamp(along, 0.0, 1.0))
    ends = step_between(-0.12, 0.08, along) * (1.0 - step_between(0.8, 1.12, along))
    body = ends * (1.0 - step_between(0.5, 1.15, wp.abs(point[1] - arc) / half))
    strokes = noise2(look.seed, 900.0 * (x - 0.45 * point[1]), 160.0 * point[1])
    return wp.clamp(body * (0.82 + 0.5 * strokes), 0.0, 1.0)


@wp.func
def skin_color(point: wp.vec3, lips: float, look: Look) -> wp.vec3:
    """Compute the colour of skin: mottling, flushed cheeks, freckles, stubble, brows and lips."""
    mottle = noise(look.seed, 55.0 * point) + 0.6 * noise(look.seed, 190.0 * point)
    pores = noise(look.seed, 620.0 * point)
    color = look.skin * (1.0 + 0.10 * mottle + 0.07 * pores)
    flush = 0.75 * blob(point, wp.vec3(0.040, -0.028, 0.018), 0.016)
    flush += 0.7 * blob(point, wp.vec3(0.0, -0.030, 0.05), 0.012)
    flush += 0.5 * blob(point, wp.vec3(0.078, -0.01, -0.07), 0.022)
    color = wp.cw_mul(color, wp.vec3(1.0, 1.0 - 0.30 * flush, 1.0 - 0.26 * flush))
    sunny = 0.10 + blob(point, wp.vec3(0.026, -0.018, 0.03), 0.022)
    freckle = spots(point, 0.0052, look.freckles * sunny, look.seed)
    mole = spots(point, 0.021, 0.10, look.seed + wp.uint32(5))
    color = wp.cw_mul(color, wp.vec3(1.0, 1.0, 1.0) - wp.vec3(0.32, 0.45, 0.52) * wp.max(freckle, 1.3 * mole))
    jaw = step_between(-0.040, -0.062, point[1]) * step_between(-0.062, -0.03, point[2])
    jaw *= step_between(-0.135, -0.105, point[1]) + blob(point, wp.vec3(0.0, -0.042, 0.04), 0.012)
    beard = look.stubble * wp.clamp(jaw, 0.0, 1.0)
    if beard > 0.0:
        bristle = wp.clamp(0.65 + 0.6 * noise(look.seed, 480.0 * point), 0.0, 1.0)
        color = wp.lerp(color, 0.45 * look.hair_dark + 0.22 * color, beard * bristle)
    socket = blob(point, wp.vec3(0.031, -0.002, 0.018), 0.013)
    color = wp.cw_mul(color, wp.vec3(1.0 - 0.16 * socket, 1.0 - 0.26 * socket, 1.0 - 0.22 * socket))
    if lips > 0.0:
        lip = look.lips * (1.0 + 0.16 * noise2(look.seed, 700.0 * point[0], 60.0 * point[1]))
        color = wp.lerp(color, lip, 0.85 * lips * (1.0 - 0.5 * look.stubble))
    if wp.abs(point[1] - 0.022) < 0.02 and point[2] > -0.03:
        color = wp.lerp(color, 0.75 * look.hair_dark, 0.88 * brow(point, look))
    return color


@wp.func
def eye_color(point: wp.vec3, look: Look) -> wp.vec3:
    """Compute the colour of an eye: pupil, fibred iris with a dark rim, veined white."""
    center = wp.vec3(wp.sign(point[0]) * look.eye_offset[0], look.eye_offset[1], look.eye_offset[2])
    out = wp.normalize(point - center)
    radius = wp.acos(wp.clamp(out[2], -1.0, 1.0)) * look.eye_radius
    around = wp.atan2(out[1], out[0])
    fibres = noise2(look.seed, 11.0 * around, 900.0 * radius)
    iris = look.iris * (1.0 + 0.55 * fibres) * (1.15 - 0.5 * step_between(0.0040, 0.0058, radius))
    white = wp.vec3(0.74, 0.70, 0.67) * (1.0 - 0.06 * noise(look.seed, 400.0 * point))
    veins = step_between(0.008, 0.013, radius)
    white = wp.cw_mul(white, wp.vec3(1.0, 1.0 - 0.30 * veins, 1.0 - 0.30 * veins))
    color = wp.lerp(iris, white, step_between(0.0056, 0.0063, radius))
    return wp.lerp(wp.vec3(0.008, 0.008, 0.009), color, step_between(0.0019, 0.0023, radius))


@wp.func
def cloth_color(point: wp.vec3, collar: float, look: Look) -> wp.vec3:
    """Compute the colour of the garment: a knitted weave with one of four patterns and a ribbed collar."""
    around = wp.atan2(point[0], point[2] + 0.08)
    across = 0.7 * around * (0.09 + 0.6 * wp.length(wp.vec2(point[0], point[2] + 0.08)))
    ink = 0.0
    if look.pattern == 1:
        ink = step_between(-0.25, 0.25, wp.sin(210.0 * point[1] + 3.0 * noise(look.seed, 9.0 * point)))
    elif look.pattern == 2:
        ink = 0.5 * step_between(0.3, 0.5, wp.sin(170.0 * across))
        ink += 0.5 * step_between(0.3, 0.5, wp.sin(170.0 * point[1]))
    elif look.pattern == 3:
        ink = step_between(0.55, 0.75, wp.sin(190.0 * across) * wp.sin(190.0 * point[1]))
    weave = wp.sin(2100.0 * point[1]) * wp.sin(1500.0 * point[0] + 1500.0 * point[2])
    ribs = wp.sin(95.0 * around)
    color = wp.lerp(look.cloth, look.print, ink * (1.0 - collar))
    color = color * (1.0 + 0.05 * weave + 0.16 * noise(look.seed, 70.0 * point))
    return color * (1.0 - collar * (0.18 - 0.14 * ribs))


@wp.func
def light_direction(i: int) -> wp.vec3:
    """Return the direction from the surface to light i: key, fill and rim, fixed in the world."""
    if i == 0:
        return wp.normalize(wp.vec3(0.55, 0.65, 0.85))
    if i == 1:
        return wp.normalize(wp.vec3(-0.85, 0.15, 0.65))
    return wp.normalize(wp.vec3(-0.25, 0.60, -0.85))


@wp.func
def light_color(i: int) -> wp.vec3:
    """Return the colour of light i, linear RGB."""
    if i == 0:
        return wp.vec3(1.72, 1.62, 1.48)
    if i == 1:
        return wp.vec3(0.50, 0.56, 0.68)
    return wp.vec3(0.62, 0.62, 0.66)


@wp.func
def gloss(normal: wp.vec3, view: wp.vec3, light: wp.vec3, power: float, base: float) -> float:
    """Compute a normalised Blinn-Phong highlight with Schlick's Fresnel term."""
    half = wp.normalize(view + light)
    grazing = 1.0 - wp.max(wp.dot(view, half), 0.0)
    fresnel = base + (1.0 - base) * grazing * grazing * grazing * grazing * grazing
    return fresnel * (power + 8.0) / 25.13 * wp.pow(wp.max(wp.dot(normal, half), 0.0), power)


@wp.func
def hair_gloss(flow: wp.vec3, normal: wp.vec3, view: wp.vec3, light: wp.vec3, shift: float) -> float:
    """Compute the highlight of fibres along ``flow``, shifted towards the roots (Kajiya and Kay)."""
    tangent = wp.normalize(flow + shift * normal)
    along = wp.dot(tangent, wp.normalize(view + light))
    return 0.30 * wp.pow(wp.sqrt(wp.max(1.0 - along * along, 0.0)), 70.0)


@wp.func
def encode(color: wp.vec3) -> wp.vec3:
    """Convert linear to display values: a soft shoulder, then sRGB's power law without its linear toe."""
    out = wp.vec3()
    for i in range(3):
        out[i] = wp.pow(1.0 - wp.exp(-1.25 * wp.max(color[i], 0.0)), 0.4545)
    return out


@wp.func
def mix3(values: wp.array[wp.vec3], corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    """Interpolate a triangle's vertex values."""
    return values[corners[0]] * weights[0] + values[corners[1]] * weights[1] + values[corners[2]] * weights[2]


@wp.func
def lit(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, light: wp.vec3) -> float:
    """Return 1 where nothing hides the key light: a hard shadow, softened by the pixel's samples."""
    if wp.dot(normal, light) <= 0.0:
        return 0.25
    if wp.mesh_query_ray_anyhit(mesh, point + 0.002 * normal + 0.001 * light, light, 0.5):
        return 0.25
    return 1.0


@wp.func
def shade(
    mesh: wp.uint64, kind: int, rest: wp.vec3, marks: wp.vec4, point: wp.vec3, normal_in: wp.vec3, flow: wp.vec3,
    view: wp.vec3, look: Look,
) -> wp.vec3:  # fmt: skip
    """Return the light that a point sends to the camera; ``marks`` are hair, lips, open sky and collar, 0..1."""
    threads = wp.float32(0.0)
    hair = wp.float32(0.0)
    power, base, rough, wrap = 22.0, 0.035, 0.10, 0.30
    color = wp.vec3(0.10, 0.025, 0.022)
    if kind == SKIN:
        if marks[0] > 0.02:
            threads = strands(rest, look.seed)
            hair = step_between(0.25, 0.55, marks[0] + 0.22 * threads)
        color = wp.lerp(look.hair_dark, look.hair_light, 0.5 + 0.5 * threads)
        if hair < 1.0:
            color = wp.lerp(skin_color(rest, marks[1], look), color, hair)
        power = 22.0 + 20.0 * marks[1]
    elif kind == EYE:
        color = eye_color(rest, look)
        power, base, rough, wrap = 350.0, 0.06, 0.0, 0.15
    elif kind == TEETH:
        color = wp.vec3(0.95, 0.86, 0.70)
        power, rough = 60.0, 0.03
    elif kind == CLOTH:
        color = cloth_color(rest, marks[3], look)
        power, base, rough, wrap = 6.0, 0.01, 0.22, 0.1
    bump = wp.vec3(noise(look.seed, 330.0 * rest), noise(look.seed, 290.0 * rest + wp.vec3(9.5, 4.5, 7.5)), 0.0)
    normal = wp.normalize(normal_in + rough * bump)
    if wp.dot(normal, view) < 0.0:
        normal = wp.normalize(normal - 1.05 * wp.dot(normal, view) * view)
    sky = 0.5 + 0.5 * normal[1]
    total = wp.cw_mul(color, wp.lerp(wp.vec3(0.20, 0.18, 0.17), wp.vec3(0.46, 0.48, 0.53), sky)) * marks[2]
    shadow = lit(mesh, point, normal_in, light_direction(0))
    for i in range(3):
        light = light_direction(i)
        reach = (0.35 + 0.65 * marks[2]) * wp.where(i == 0, shadow, 1.0)
        facing = wp.max((wp.dot(normal, light) + wrap) / (1.0 + wrap), 0.0)
        skin_gloss = wp.float32(0.0)
        if hair < 1.0:
            skin_gloss = (1.0 - hair) * gloss(normal, view, light, power, base) * wp.max(wp.dot(normal, light), 0.0)
        fibre = wp.float32(0.0)
        if hair > 0.0:
            fibre = hair * hair_gloss(flow, normal, view, light, 0.12 + 0.25 * threads) * facing
        sheen = wp.vec3(1.0, 1.0, 1.0) * skin_gloss + fibre * (1.2 * look.hair_light + wp.vec3(0.03, 0.03, 0.03))
        total += wp.cw_mul(0.75 * facing * color + sheen, light_color(i)) * reach
    return encode(total)


@wp.kernel
def _portrait_kernel(
    # In:
    first: int,
    mesh: wp.uint64,
    view: View,
    look: Look,
    samples: wp.array[wp.vec2],  # [S]
    faces: wp.array[wp.vec3i],  # [F]
    kinds: wp.array[wp.int32],  # [F]
    rest: wp.array[wp.vec3],  # [V]
    marks: wp.array[wp.vec4],  # [V]
    normals: wp.array[wp.vec3],  # [V]
    flows: wp.array[wp.vec3],  # [V]
    # Out:
    pixels: wp.array[wp.vec4],  # [P]
) -> None:
    n = first + wp.tid()
    corner = view.corner + wp.vec2(float(n % view.columns), float(n // view.columns))
    total = wp.vec4()
    low = wp.vec4(1.0, 1.0, 1.0, 1.0)
    high = wp.vec4()
    count = wp.int32(0)
    for s in range(samples.shape[0]):
        if s == 4 and wp.length(high - low) < 0.14:
            break
        xy = wp.cw_div(corner + samples[s] - view.center, view.focal)
        direction = wp.normalize(view.to_world @ wp.vec3(xy[0], xy[1], 1.0))
        hit = wp.mesh_query_ray(mesh, view.origin, direction, FAR)
        value = wp.vec4()
        if hit.result:
            ids = faces[hit.face]
            w = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
            mark = marks[ids[0]] * w[0] + marks[ids[1]] * w[1] + marks[ids[2]] * w[2]
            normal = wp.normalize(mix3(normals, ids, w))
            point = view.origin + hit.t * direction
            color = shade(
                mesh, kinds[hit.face], mix3(rest, ids, w), mark, point, normal, mix3(flows, ids, w), -direction, look
            )  # fmt: skip
            value = wp.vec4(color[0], color[1], color[2], 1.0)
        total += value
        low = wp.min(low, value)
        high = wp.max(high, value)
        count += 1
    pixels[n] = total / float(count)


def portrait(
    mesh: RayMesh,
    view: View,
    look: Look,
    *,
    samples: Tensor,
    n_pixels: int,
    surface: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor],
) -> Tensor:
    """Render a synthetic person: colour and alpha of every pixel of ``view``'s rectangle, row by row.

    Diffuse and Blinn-Phong light with Schlick's Fresnel term, Kajiya-Kay highlights on hair, one shadowing light.

    Args:
        mesh: The posed surface [m].
        view: Camera and rectangle.
        look: Colours and patterns.
        samples: Positions inside a pixel, in 0..1, shape [S, 2], float32; only where the first four
            differ are the others drawn.
        n_pixels: Pixels in the rectangle, P.
        surface: ``faces`` [F, 3] int32, their material [F] int32; per vertex its resting point [m] [V, 3], marks (hair,
            lips, open sky, collar) [V, 4], unit normal [V, 3] and hair direction [V, 3], float32.

    Returns:
        Display colour times alpha, and alpha, each in 0..1, shape [P, 4], float32.

    Raises:
        ValueError: If the parts of ``surface`` differ in length.
    """
    faces, kinds, *per_vertex = surface
    if len(faces) != len(kinds) or len({len(values) for values in per_vertex}) != 1:
        raise ValueError(f"surface has parts of lengths {[len(values) for values in surface]}")
    pixels = torch.zeros((n_pixels, 4), device=faces.device)
    if n_pixels and mesh.id:
        launch_ranges(_portrait_kernel, n_pixels, (mesh.id, view, look, samples, *surface), (pixels,))
    return pixels
