"""Slow twins of the package's numerics, in plain loops and dense algebra. Nothing here imports torchvts."""

import numpy as np


def pixel_mm(row, column, height, width, pitch):
    return (column - (width - 1) / 2) * pitch, (row - (height - 1) / 2) * pitch


def light_rows(x, y, z, position, albedo):
    """The 3 x 3 matrix L of I = L n at one point (eq. 2)."""
    rows = np.empty((3, 3))
    for j in range(3):
        to_light = position[j] - np.array([x, y, z])
        rows[j] = albedo[j] * to_light / np.linalg.norm(to_light) ** 3
    return rows


def each_pixel(depth, pitch):
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            yield row, column, (*pixel_mm(row, column, height, width, pitch), depth[row, column])


def shade(depth, normal, position, albedo, pitch):
    """Image (3, H, W) of depth (H, W) and normals (3, H, W): eq. 1, attached shadows at zero."""
    image = np.empty((3, *depth.shape))
    for row, column, point in each_pixel(depth, pitch):
        image[:, row, column] = np.maximum(0, light_rows(*point, position, albedo) @ normal[:, row, column])
    return image


def inverse_light(depth, position, albedo, pitch):
    """Inverse light matrices (3, 3, H, W), each by a general 3 x 3 inverse."""
    inverse = np.empty((3, 3, *depth.shape))
    for row, column, point in each_pixel(depth, pitch):
        inverse[:, :, row, column] = np.linalg.inv(light_rows(*point, position, albedo))
    return inverse


def edge_system(gradient, pitch):
    """Edge differences A z = b of all pixels of a gradient map (2, H, W); an edge's slope is the mean of its two ends."""
    _, height, width = gradient.shape
    rows, right = [], []
    for row in range(height):
        for column in range(width):
            here = row * width + column
            for there, axis, inside in ((here + 1, 0, column + 1 < width), (here + width, 1, row + 1 < height)):
                if inside:
                    line = np.zeros(height * width)
                    line[here], line[there] = -1, 1
                    rows.append(line)
                    end = gradient[axis].reshape(-1)[there]
                    right.append(pitch * 0.5 * (gradient[axis, row, column] + end))
    return np.array(rows), np.array(right)


def poisson_free(gradient, pitch):
    """Least squares over all edges, zero mean: the solution of least norm."""
    matrix, right = edge_system(gradient, pitch)
    return np.linalg.lstsq(matrix, right, rcond=None)[0].reshape(gradient.shape[1:])


def poisson_zero(gradient, pitch):
    """Least squares over all edges with the border held at zero."""
    matrix, right = edge_system(gradient, pitch)
    inside = np.zeros(gradient.shape[1:], dtype=bool)
    inside[1:-1, 1:-1] = True
    free = matrix[:, inside.reshape(-1)]
    depth = np.zeros(gradient.shape[1:])
    depth[inside] = np.linalg.solve(free.T @ free, free.T @ right)
    return depth


def cliffs(gradient, contact, pitch, slope_std, threshold, rim_weight, depth):
    """One more dense pass of robust integration from a depth map (H, W): weights by its residuals, zero outside the contact."""
    _, height, width = gradient.shape
    normal, right = np.zeros((height * width, height * width)), np.zeros(height * width)
    variance = (slope_std * (1 + (gradient**2).sum(0))) ** 2
    for row in range(height):
        for column in range(width):
            for down, axis in ((0, 0), (1, 1)):
                r, c = row + down, column + 1 - down
                if r >= height or c >= width:
                    continue
                g = gradient[axis, row, column], gradient[axis, r, c]
                v = (variance[row, column] + variance[r, c]) / 2 + (g[1] - g[0]) ** 2 / 12
                misfit = (depth[r, c] - depth[row, column]) / pitch - (g[0] + g[1]) / 2
                weight = (rim_weight if contact[row, column] != contact[r, c] else 1) * slope_std**2 / v
                weight /= 1 + misfit**2 / (threshold**2 * v)
                a, b = row * width + column, r * width + c
                normal[[a, b], [a, b]] += weight
                normal[[a, b], [b, a]] -= weight
                right[b] += weight * pitch * (g[0] + g[1]) / 2
                right[a] -= weight * pitch * (g[0] + g[1]) / 2
    inside = contact.reshape(-1)
    found = np.zeros(height * width)
    found[inside] = np.linalg.solve(normal[np.ix_(inside, inside)], right[inside])
    return found.reshape(height, width)


def metallic_roughness_image(depth, normal, lights, power, pitch, base=1.0, metallic=0.2, roughness=0.8):
    """Light (3, H, W) of point lights on a surface as renderers of glTF shade it: the fragment shader of pyrender, line by line.

    Args:
        depth: (H, W), mm, towards an orthographic camera. normal: (3, H, W). lights: (3, 3), mm. power: (3,).
    """
    height, width = depth.shape
    x, y = (np.arange(width) - (width - 1) / 2) * pitch, (np.arange(height) - (height - 1) / 2) * pitch
    point = np.stack([np.broadcast_to(x, depth.shape), np.broadcast_to(y[:, None], depth.shape), depth])
    f0, diffuse = 0.04 * (1 - metallic) + base * metallic, base * (1 - 0.04) * (1 - metallic)
    image = []
    for light, strength in zip(lights, power):
        way = light[:, None, None] - point
        distance = np.sqrt((way**2).sum(0))
        to_light = way / distance
        half = to_light + np.array([0.0, 0.0, 1.0])[:, None, None]
        half /= np.sqrt((half**2).sum(0))
        nl, nv = np.clip((normal * to_light).sum(0), 0.001, 1), np.clip(normal[2], 0.001, 1)
        nh, vh = np.clip((normal * half).sum(0), 0, 1), np.clip(half[2], 0, 1)
        fresnel = f0 + (1 - f0) * (1 - vh) ** 5
        k, a = (roughness + 1) ** 2 / 8, roughness**4
        masking = nv / (nv * (1 - k) + k) * nl / (nl * (1 - k) + k)
        lobe = a / (np.pi * (nh**2 * (a - 1) + 1) ** 2)
        image.append(
            nl * strength / distance**2 * ((1 - fresnel) * diffuse / np.pi + fresnel * masking * lobe / (4 * nl * nv + 0.001))
        )
    return np.stack(image)
