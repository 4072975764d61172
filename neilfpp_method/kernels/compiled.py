"""Loops for hash grids, sphere tracing, sums of rows and softplus on a CPU, compiled by Numba and cached on
disk.

The loops release the global interpreter lock, start no threads, and add numbers in a fixed order. All of them
are in this file because Numba compiles a function again only if the file of that function has changed; it
does not notice changes in other files.

A hash grid is passed as three arrays with one entry per level: `offsets` (the first table row, followed by
the number of all rows), `cells` along an edge, and `dense` (whether each vertex has its own row). The
vertices of a cell are numbered x + 2 y + 4 z, with coordinates 0 or 1. All arrays are contiguous; the
floating-point arrays of a call have the same type.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

__all__ = [
    "add_to_table",
    "add_weighted_rows",
    "interpolate",
    "point_gradient",
    "softplus",
    "softplus_and_slope",
    "softplus_gradient",
    "sphere_trace",
]

BLOCK = 128
"""Number of points for which all levels are computed before the next points, so that what they write stays
in the first-level cache."""
Y_PRIME, Z_PRIME = np.uint32(2654435761), np.uint32(805459861)
"""Factors of y and z in the spatial hash (Müller et al. 2022, eq. 4); that of x is 1."""
ONE = np.uint32(1)


def compiled(function: Callable) -> Callable:
    """Compile a function. A product and a sum may be fused; all other arithmetic stays as written."""
    # A run-time type checker may have wrapped the function.
    function = inspect.unwrap(function)
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:
        # No cache folder is writable, so each process compiles the function again.
        return njit(**options)(function)


# --------------------------------------------------------------------------------------------------- one cell


@compiled
def _locate(points, n, axis, cells):
    """Find the cell of a point along one axis.

    Returns the index of the cell, the position within it (0 to 1), and the derivative of the position in
    units of the cell with respect to the coordinate, which is 0 outside of the unit cube.
    """
    number = points.dtype.type
    free = points[n, axis] * number(cells)
    position = min(max(free, number(0)), number(cells))
    start = min(np.floor(position), number(cells - 1))
    # NaN gets the first cell; the fraction is NaN, and so is everything that is computed from it.
    cell = np.uint32(start) if start > 0 else np.uint32(0)
    return cell, position - start, number(cells if position == free else 0)


@compiled
def _vertices(i, j, k, cells, entries, dense):
    """Return the rows of a cell's eight vertices in the table of its level."""
    if dense:
        step = np.uint32(cells) + ONE
        a = i + step * (j + step * k)
        b, c = a + step, a + step * step
        d = c + step
        return a, a + ONE, b, b + ONE, c, c + ONE, d, d + ONE
    mask = np.uint32(entries) - ONE
    y0, y1, z0, z1 = j * Y_PRIME, (j + ONE) * Y_PRIME, k * Z_PRIME, (k + ONE) * Z_PRIME
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    o = i + ONE
    lower = (i ^ a) & mask, (o ^ a) & mask, (i ^ b) & mask, (o ^ b) & mask
    upper = (i ^ c) & mask, (o ^ c) & mask, (i ^ d) & mask, (o ^ d) & mask
    return lower + upper


@compiled
def _value_and_slopes(corners, x, y, z):
    """Return the trilinear interpolation, and its derivative along each axis per unit of the cell."""
    c0, c1, c2, c3, c4, c5, c6, c7 = corners
    z0, z1, z2, z3 = c4 - c0, c5 - c1, c6 - c2, c7 - c3
    b0, b1, b2, b3 = c0 + z * z0, c1 + z * z1, c2 + z * z2, c3 + z * z3
    y0, y1 = b2 - b0, b3 - b1
    left, right = b0 + y * y0, b1 + y * y1
    back, front = z0 + y * (z2 - z0), z1 + y * (z3 - z1)
    return left + x * (right - left), right - left, y0 + x * (y1 - y0), back + x * (front - back)


@compiled
def _mixed_derivatives(corners, x, y, z):
    """Return the mixed second derivatives xy, xz, yz per unit of the cell; xx, yy and zz are 0."""
    c0, c1, c2, c3, c4, c5, c6, c7 = corners
    low, high = c3 - c2 - c1 + c0, c7 - c6 - c5 + c4
    near, far = c5 - c4 - c1 + c0, c7 - c6 - c3 + c2
    left, right = c6 - c4 - c2 + c0, c7 - c5 - c3 + c1
    return low + z * (high - low), near + y * (far - near), left + x * (right - left)


@compiled
def _corners(rows, vertices, f):
    a, b, c, d, e, g, h, i = vertices
    return rows[a, f], rows[b, f], rows[c, f], rows[d, f], rows[e, f], rows[g, f], rows[h, f], rows[i, f]


# -------------------------------------------------------------------------------------------------- the loops


@compiled
def interpolate(points, table, offsets, cells, dense, features, jacobian, with_jacobian, start, stop):
    """Write the features, and if `with_jacobian` the Jacobian, of the points in [start, stop)."""
    for block in range(start, stop, BLOCK):
        end = min(block + BLOCK, stop)
        for level in range(len(cells)):
            rows = table[offsets[level] : offsets[level + 1]]
            # Test `dense` once per level, not once per point.
            if dense[level]:
                _interpolate_level(
                    points, rows, level, cells[level], True, features, jacobian, with_jacobian, block, end
                )
            else:
                _interpolate_level(
                    points, rows, level, cells[level], False, features, jacobian, with_jacobian, block, end
                )


@compiled
def _interpolate_level(points, rows, level, cells, dense, features, jacobian, with_jacobian, start, stop):
    width = rows.shape[1]
    for n in range(start, stop):
        i, x, dx = _locate(points, n, 0, cells)
        j, y, dy = _locate(points, n, 1, cells)
        k, z, dz = _locate(points, n, 2, cells)
        vertices = _vertices(i, j, k, cells, len(rows), dense)
        for f in range(width):
            value, along_x, along_y, along_z = _value_and_slopes(_corners(rows, vertices, f), x, y, z)
            column = level * width + f
            features[n, column] = value
            if with_jacobian:
                jacobian[n, column, 0] = along_x * dx
                jacobian[n, column, 1] = along_y * dy
                jacobian[n, column, 2] = along_z * dz


@compiled
def add_to_table(points, offsets, cells, dense, features, jacobian, with_jacobian, table, first, last):
    """Add the gradient of a loss to that of the table, for the levels in [first, last).

    `features` and `jacobian` are the gradients of the loss with respect to features and Jacobian.
    """
    width = table.shape[1]
    number = points.dtype.type
    for level in range(first, last):
        rows = table[offsets[level] : offsets[level + 1]]
        for n in range(len(points)):
            i, x, dx = _locate(points, n, 0, cells[level])
            j, y, dy = _locate(points, n, 1, cells[level])
            k, z, dz = _locate(points, n, 2, cells[level])
            a, b, c, d, e, g, h, m = _vertices(i, j, k, cells[level], len(rows), dense[level])
            rest_x, rest_y, rest_z = number(1) - x, number(1) - y, number(1) - z
            for f in range(width):
                column = level * width + f
                value, along_x, along_y, along_z = features[n, column], number(0), number(0), number(0)
                if with_jacobian:
                    along_x, along_y = jacobian[n, column, 0] * dx, jacobian[n, column, 1] * dy
                    along_z = jacobian[n, column, 2] * dz
                # The transpose of `_value_and_slopes`: along x, then y, then z.
                left, right = rest_x * value - along_x, x * value + along_x
                b0, b1 = rest_y * left - rest_x * along_y, rest_y * right - x * along_y
                b2, b3 = y * left + rest_x * along_y, y * right + x * along_y
                back, front = rest_x * along_z, x * along_z
                z0, z1, z2, z3 = rest_y * back, rest_y * front, y * back, y * front
                rows[a, f] += rest_z * b0 - z0
                rows[b, f] += rest_z * b1 - z1
                rows[c, f] += rest_z * b2 - z2
                rows[d, f] += rest_z * b3 - z3
                rows[e, f] += z * b0 + z0
                rows[g, f] += z * b1 + z1
                rows[h, f] += z * b2 + z2
                rows[m, f] += z * b3 + z3


@compiled
def point_gradient(
    points, table, offsets, cells, dense, features, jacobian, with_jacobian, gradient, start, stop
):
    """Write the gradient of a loss with respect to the points in [start, stop).

    `features` and `jacobian` are the gradients of the loss with respect to features and Jacobian.
    """
    width = table.shape[1]
    number = points.dtype.type
    for n in range(start, stop):
        to_x, to_y, to_z = number(0), number(0), number(0)
        for level in range(len(cells)):
            rows = table[offsets[level] : offsets[level + 1]]
            i, x, dx = _locate(points, n, 0, cells[level])
            j, y, dy = _locate(points, n, 1, cells[level])
            k, z, dz = _locate(points, n, 2, cells[level])
            vertices = _vertices(i, j, k, cells[level], len(rows), dense[level])
            for f in range(width):
                corners = _corners(rows, vertices, f)
                column = level * width + f
                _, along_x, along_y, along_z = _value_and_slopes(corners, x, y, z)
                value = features[n, column]
                by_x, by_y, by_z = value * along_x, value * along_y, value * along_z
                if with_jacobian:
                    gx, gy = jacobian[n, column, 0] * dx, jacobian[n, column, 1] * dy
                    gz = jacobian[n, column, 2] * dz
                    xy, xz, yz = _mixed_derivatives(corners, x, y, z)
                    by_x += gy * xy + gz * xz
                    by_y += gx * xy + gz * yz
                    by_z += gx * xz + gy * yz
                to_x += by_x * dx
                to_y += by_y * dy
                to_z += by_z * dz
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = to_x, to_y, to_z


@compiled
def sphere_trace(
    grid, radius, origins, directions, hit_distance, leaves_surface, max_steps, distance, hit, start, stop
):
    """Trace the rays in [start, stop) in a grid of distances; see `tracing.sphere_trace`.

    Writes the length of each ray, and whether it hit a surface.
    """
    number = grid.dtype.type
    cells = len(grid) - 1
    edge, reach = number(2 * radius / cells), number(radius)
    for n in range(start, stop):
        length, is_hit, threshold = number(0), False, hit_distance
        for step in range(max_steps):
            x = origins[n, 0] + length * directions[n, 0]
            y = origins[n, 1] + length * directions[n, 1]
            z = origins[n, 2] + length * directions[n, 2]
            if abs(x) > reach or abs(y) > reach or abs(z) > reach:
                break
            clearance = _at_vertices(grid, (x + reach) / edge, (y + reach) / edge, (z + reach) / edge, cells)
            if clearance >= hit_distance:
                threshold = hit_distance
            elif leaves_surface and step == 0:
                threshold = min(clearance, number(0)) - hit_distance
            if clearance < threshold:
                is_hit = True
                break
            length += max(clearance, hit_distance)
        distance[n], hit[n] = length, is_hit


@compiled
def _at_vertices(grid, x, y, z, cells):
    """Interpolate trilinearly at a point in units of cells; the result is NaN if the point is."""
    number = grid.dtype.type
    last = number(cells - 1)
    low_x, low_y, low_z = min(np.floor(x), last), min(np.floor(y), last), min(np.floor(z), last)
    i, j, k = (
        (int(low_x) if low_x > 0 else 0),
        (int(low_y) if low_y > 0 else 0),
        (int(low_z) if low_z > 0 else 0),
    )
    x, y, z = x - low_x, y - low_y, z - low_z
    near = grid[k, j, i] + x * (grid[k, j, i + 1] - grid[k, j, i])
    far = grid[k, j + 1, i] + x * (grid[k, j + 1, i + 1] - grid[k, j + 1, i])
    front = near + y * (far - near)
    near = grid[k + 1, j, i] + x * (grid[k + 1, j, i + 1] - grid[k + 1, j, i])
    far = grid[k + 1, j + 1, i] + x * (grid[k + 1, j + 1, i + 1] - grid[k + 1, j + 1, i])
    back = near + y * (far - near)
    return front + z * (back - front)


# ----------------------------------------------------------------------------------------------- sums of rows


@compiled
def add_weighted_rows(matrix, weights, sums, start, stop):
    """Add matrix[n, t] · weights[n, c] for the rows n in [start, stop) to sums[c, t], for three columns c.

    Four rows are added at once, so that the sums are read and written a quarter as often.
    """
    red, green, blue = sums[0], sums[1], sums[2]
    fours = start + (stop - start) // 4 * 4
    for n in range(start, fours, 4):
        a, b, c, d = matrix[n], matrix[n + 1], matrix[n + 2], matrix[n + 3]
        r0, r1, r2, r3 = weights[n, 0], weights[n + 1, 0], weights[n + 2, 0], weights[n + 3, 0]
        g0, g1, g2, g3 = weights[n, 1], weights[n + 1, 1], weights[n + 2, 1], weights[n + 3, 1]
        b0, b1, b2, b3 = weights[n, 2], weights[n + 1, 2], weights[n + 2, 2], weights[n + 3, 2]
        for t in range(len(a)):
            red[t] += a[t] * r0 + b[t] * r1 + c[t] * r2 + d[t] * r3
            green[t] += a[t] * g0 + b[t] * g1 + c[t] * g2 + d[t] * g3
            blue[t] += a[t] * b0 + b[t] * b1 + c[t] * b2 + d[t] * b3
    for n in range(fours, stop):
        row, r, g, v = matrix[n], weights[n, 0], weights[n, 1], weights[n, 2]
        for t in range(len(row)):
            red[t] += row[t] * r
            green[t] += row[t] * g
            blue[t] += row[t] * v


# ------------------------------------------------------------------------------ softplus, computed in float32

MAX_EXPONENT = np.float32(40)
"""Largest exponent t of `_exp_of_negative`: 1 + e^−40 is 1 in float32, and the square of e^−40 is not yet a
denormal number."""
HALF, UNIT = np.float32(0.5), np.float32(1)


@intrinsic
def _from_bits(_context, _bits):
    """Reinterpret the bits of an int32 as a float32."""

    def code(context, builder, _signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), code


@compiled
def _exp_of_negative(t):
    """Return e^−t for 0 ≤ t ≤ `MAX_EXPONENT`, to one or two units in the last place; larger t are clamped.

    e^−t = 2^−n e^r with |r| ≤ ½ ln 2. e^r is computed by its Taylor series, and ln 2 is split into two parts
    to keep r exact (Cody & Waite 1980).
    """
    # This comparison is false for NaN, so NaN remains.
    t = MAX_EXPONENT if t > MAX_EXPONENT else t
    n = np.int32(t * np.float32(1.4426950408889634) + HALF)
    r = np.float32(n) * np.float32(0.693359375) - t
    r = r - np.float32(n) * np.float32(2.12194440e-4)
    series = np.float32(1 / 720) + r * np.float32(1 / 5040)
    series = np.float32(1 / 24) + r * (np.float32(1 / 120) + r * series)
    series = UNIT + r * (UNIT + r * (HALF + r * (np.float32(1 / 6) + r * series)))
    return series * _from_bits(np.int32((np.int32(127) - n) << np.int32(23)))


@compiled
def _log1p(e):
    """Return ln(1 + e) for 0 ≤ e ≤ 1 with an error of at most 2e-8.

    The result is e times the Chebyshev approximation of ln(1 + e) / e of degree 8.
    """
    tail = np.float32(0.07836167) + e * (np.float32(-0.029588507) + e * np.float32(0.005253458))
    tail = np.float32(-0.24844369) + e * (np.float32(0.19111431) + e * (np.float32(-0.1367477) + e * tail))
    return e * (UNIT + e * (np.float32(-0.49999502) + e * (np.float32(0.3331927) + e * tail)))


@compiled
def softplus(z, value, sharpness, start, stop):
    """Write ln(1 + e^(sharpness z)) / sharpness for the numbers in [start, stop)."""
    sharp = np.float32(sharpness)
    # The compiler vectorises a loop that starts at 0.
    z, value = z[start:stop], value[start:stop]
    for n in range(len(z)):
        rest = _log1p(_exp_of_negative(abs(z[n]) * sharp)) / sharp
        value[n] = rest + (z[n] if z[n] > 0 else np.float32(0))


@compiled
def softplus_and_slope(z, value, slope, sharpness, start, stop):
    """Write softplus and its derivative 1 / (1 + e^(−sharpness z)) for the numbers in [start, stop)."""
    sharp = np.float32(sharpness)
    z, value, slope = z[start:stop], value[start:stop], slope[start:stop]
    for n in range(len(z)):
        e = _exp_of_negative(abs(z[n]) * sharp)
        value[n] = _log1p(e) / sharp + (z[n] if z[n] > 0 else np.float32(0))
        share = UNIT / (UNIT + e)
        slope[n] = share if z[n] > 0 else e * share


@compiled
def softplus_gradient(slope, to_value, to_slope, gradient, sharpness, start, stop):
    """Write the gradient of a loss with respect to z, for the numbers in [start, stop).

    `to_value` and `to_slope` are the gradients of the loss with respect to the outputs of
    `softplus_and_slope`.
    """
    sharp = np.float32(sharpness)
    slope, to_value, to_slope = slope[start:stop], to_value[start:stop], to_slope[start:stop]
    gradient = gradient[start:stop]
    for n in range(len(slope)):
        gradient[n] = slope[n] * (to_value[n] + to_slope[n] * sharp * (UNIT - slope[n]))
