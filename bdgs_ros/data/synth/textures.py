"""Procedural textures: what the surfaces of the room and the clothes look like."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]  # [h, w, 3] RGB albedo in [0, 1]
Rgb = tuple[float, float, float]


def noise(
    rng: np.random.Generator, height: int, width: int, scale: float, octaves: int = 4
) -> NDArray[np.float32]:
    """Return fractal value noise in about [-1, 1]; `scale` is its coarsest cell in texels."""
    total = np.zeros((height, width), np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        cells = (max(2, round(width / scale) + 1), max(2, round(height / scale) + 1))
        grid = rng.uniform(-1, 1, cells[::-1]).astype(np.float32)
        total += amplitude * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        amplitude *= 0.55
        scale = max(scale / 2, 1.0)
    return total


def color(rng: np.random.Generator, low: float = 0.15, high: float = 0.75) -> Rgb:
    """Draw a colour that neither saturates nor vanishes."""
    rgb = rng.uniform(low, high, 3)
    r, g, b = rgb.mean() + 0.75 * (rgb - rgb.mean())  # paint is rarely pure
    return float(r), float(g), float(b)


def plain(height: int, width: int, rgb: Rgb) -> Texture:
    """Return one colour."""
    return np.broadcast_to(np.array(rgb, np.float32), (height, width, 3)).copy()


def grainy(
    rng: np.random.Generator, height: int, width: int, rgb: Rgb, scale: float, strength: float
) -> Texture:
    """Return one colour under fractal noise: plaster, paint, leather."""
    return plain(height, width, rgb) * (1 + strength * noise(rng, height, width, scale))[..., None]


def wall(rng: np.random.Generator, height: int, width: int, density: float) -> Texture:
    """Return a painted wall: almost plain on one part, stained and patterned on the other."""
    rgb = color(rng, 0.48, 0.62)
    texture = grainy(rng, height, width, rgb, density * 1.2, 0.03)
    pattern = grainy(rng, height, width, color(rng, 0.4, 0.7), density * 0.25, 0.25)
    ramp = np.linspace(0, 1, width, dtype=np.float32)
    start = rng.uniform(0.35, 0.6)
    weight = np.clip((ramp - start) / 0.02, 0, 1)
    if rng.random() < 0.5:
        weight = weight[::-1]
    texture += (pattern - texture) * (0.8 * weight)[None, :, None]
    board = int(0.1 * density)
    texture[-board:] = grainy(rng, board, width, (0.3, 0.24, 0.2), 40, 0.2)
    return texture


def wood(rng: np.random.Generator, height: int, width: int, rgb: Rgb | None = None) -> Texture:
    """Return wood with its grain along the longer side."""
    if height > width:
        return np.ascontiguousarray(wood(rng, width, height, rgb).transpose(1, 0, 2))
    tone = rng.uniform(0.75, 1.15)
    base = rgb or (0.52 * tone, 0.37 * tone, rng.uniform(0.2, 0.27) * tone)
    small = noise(rng, max(height, 4), max(width // 12, 4), 24, 4)
    warp = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    rows = np.arange(height, dtype=np.float32)[:, None]
    grain = 0.16 * np.sin(rows * 0.22 + 7 * warp) + 0.10 * warp
    fine = noise(rng, height, width, 4, 1) * 0.06
    return np.asarray(plain(height, width, base) * (1 + grain + fine)[..., None], np.float32)


def planks(rng: np.random.Generator, height: int, width: int, density: float) -> Texture:
    """Return a wooden floor of staggered boards."""
    texture = np.empty((height, width, 3), np.float32)
    sheet = wood(rng, 1024, 2048)
    board, length = int(0.14 * density), int(1.1 * density)
    for row in range(0, height, board):
        start = -int(rng.integers(length))
        for column in range(start, width, length):
            left, right = max(column, 0), min(column + length, width)
            h = min(board, height - row)
            y, x = rng.integers(0, 1024 - h), rng.integers(0, 2048 - (right - left))
            piece = sheet[y : y + h, x : x + right - left] * rng.uniform(0.75, 1.15)
            piece[:2] *= 0.6
            piece[:, :2] *= 0.6
            texture[row : row + h, left:right] = piece
    return texture


def poster(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Return a print: a ground, shapes of many sizes, rows of something like text, a frame."""
    texture = grainy(rng, height, width, color(rng, 0.3, 0.8), 60, 0.15)
    for _ in range(int(rng.integers(18, 40))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        radius = int(rng.uniform(0.02, 0.22) * min(height, width)) + 2
        if rng.random() < 0.5:
            cv2.circle(texture, centre, radius, color(rng, 0.05, 0.85), -1, cv2.LINE_AA)
        else:
            points = np.array(centre) + rng.integers(-2 * radius, 2 * radius + 1, (4, 2))
            hull = cv2.convexHull(points.astype(np.int32))
            cv2.fillConvexPoly(texture, hull, color(rng, 0.05, 0.85), cv2.LINE_AA)
    _write_text(rng, texture)
    border = max(3, min(height, width) // 40)
    cv2.rectangle(texture, (0, 0), (width - 1, height - 1), color(rng, 0.05, 0.3), border)
    return texture


def _write_text(rng: np.random.Generator, texture: Texture) -> None:
    height, width = texture.shape[:2]
    ink = color(rng, 0.02, 0.25)
    for row in range(int(height * 0.72), int(height * 0.92), max(height // 24, 8)):
        column = width // 10
        while column < width * 0.85:
            step = int(rng.integers(3, max(5, width // 14)))
            cv2.rectangle(
                texture, (column, row), (column + step, row + max(height // 60, 3)), ink, -1
            )
            column += step + max(width // 60, 3)


def rug(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Return a carpet of nested coloured bands with a woven fine structure."""
    yy, xx = np.mgrid[0:height, 0:width].astype(np.float32)
    border = np.minimum(np.minimum(xx, width - xx), np.minimum(yy, height - yy))
    palette = np.array([color(rng, 0.15, 0.65) for _ in range(7)], np.float32)
    cell = min(height, width) / 14
    diamonds = (np.abs((xx % (2 * cell)) - cell) + np.abs((yy % (2 * cell)) - cell)) / cell
    index = np.where(border < 3 * cell, border // (0.75 * cell), 4 + (diamonds > 0.9))
    index = np.where(diamonds > 1.5, 6, index).astype(int) % 7
    return np.asarray(
        palette[index] * (1 + 0.22 * noise(rng, height, width, 8, 3))[..., None], np.float32
    )


def books(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Return a row of book spines."""
    texture = plain(height, width, (0.08, 0.07, 0.06))
    column = 0
    while column < width - 4:
        w = min(int(rng.uniform(0.12, 0.3) * height) + 4, width - column)
        top = int(rng.uniform(0.0, 0.25) * height)
        rgb = color(rng, 0.08, 0.75)
        texture[top:, column : column + w] = grainy(rng, height - top, w, rgb, 12, 0.12)
        texture[top:, column : column + 1] *= 0.4
        band = top + int(rng.uniform(0.15, 0.5) * (height - top))
        texture[band : band + max(height // 14, 2), column + 2 : column + w - 2] = color(rng)
        column += w
    return texture


def carton(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Return a side of a cardboard box with tape and print."""
    texture = grainy(rng, height, width, (0.58, 0.43, 0.27), 40, 0.12)
    tape = max(height // 9, 3)
    texture[height // 2 - tape // 2 : height // 2 + tape // 2 + 1] *= (1.15, 1.2, 1.1)
    for _ in range(5):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        w, h = int(rng.uniform(0.05, 0.3) * width), int(rng.uniform(0.04, 0.15) * height)
        cv2.rectangle(texture, (x, y), (x + w, y + h), color(rng, 0.05, 0.4), -1)
    return texture


def cloth(rng: np.random.Generator, height: int, width: int, rgb: Rgb) -> Texture:
    """Return a garment: plain, striped, chequered or printed, with folds."""
    texture = plain(height, width, rgb)
    second = np.array(color(rng, 0.1, 0.75), np.float32)
    yy, xx = np.mgrid[0:height, 0:width]
    kind = rng.integers(4)
    period = int(rng.integers(12, 28))
    if kind == 1:
        texture[(yy // period) % 2 == 0] = second
    elif kind == 2:
        texture[(yy // period + xx // period) % 2 == 0] *= 0.6
    elif kind == 3:
        h, w = max(height // 3, 1), max(width // 5, 1)
        x = (width - w) // 2
        texture[h : 2 * h, x : x + w] = poster(rng, h, w)
    folds = noise(rng, height, width, 40, 3) * 0.12 + noise(rng, height, width, 3, 1) * 0.05
    return np.asarray(texture * (1 + folds)[..., None], np.float32)


def head(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Return a head unrolled by azimuth (columns, face in the middle) and height (rows)."""
    skin = skin_color(rng)
    hair = np.array(color(rng, 0.03, 0.3), np.float32) * (1.0, 0.8, 0.6)
    texture = grainy(rng, height, width, skin, 30, 0.05)
    azimuth = np.abs(np.linspace(-np.pi, np.pi, width))[None, :]
    level = np.linspace(0, 1, height)[:, None]
    hairline = np.where(azimuth < 0.9, 0.24, 0.24 + 0.45 * np.clip((azimuth - 0.9) / 0.5, 0, 1))
    strands = 1 + 0.35 * noise(rng, height, width, 6, 2)
    covered = (level < hairline + 0.02 * strands)[..., None]
    texture = np.where(covered, hair * strands[..., None], texture).astype(np.float32)
    _draw_face(texture, skin)
    return texture


def _draw_face(texture: Texture, skin: Rgb) -> None:
    height, width = texture.shape[:2]
    middle = width // 2
    for side in (-1, 1):
        eye = (middle + side * int(0.075 * width), int(0.47 * height))
        axes = (int(0.028 * width), int(0.028 * height))
        cv2.ellipse(texture, eye, axes, 0, 0, 360, (0.8, 0.8, 0.78), -1, cv2.LINE_AA)
        cv2.circle(texture, eye, max(axes[1] - 1, 1), (0.08, 0.06, 0.05), -1, cv2.LINE_AA)
        brow = (eye[0], int(0.40 * height))
        cv2.ellipse(texture, brow, (axes[0] + 2, 2), 0, 0, 360, (0.1, 0.07, 0.05), -1)
    shade = tuple(0.75 * c for c in skin)
    cv2.ellipse(
        texture, (middle, int(0.56 * height)), (int(0.02 * width), 3), 0, 0, 360, shade, -1
    )
    mouth = (middle, int(0.67 * height))
    cv2.ellipse(texture, mouth, (int(0.05 * width), 3), 0, 0, 360, (0.5, 0.2, 0.2), -1)


def skin_color(rng: np.random.Generator) -> Rgb:
    """Draw a colour of skin."""
    tone = float(rng.uniform(0.6, 1.1))
    return 0.82 * tone, 0.6 * tone, 0.48 * tone


def ball(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Return a ball of coloured segments with dots, so that its rolling is seen."""
    palette = np.array([color(rng, 0.2, 0.8) for _ in range(3)], np.float32)
    texture = palette[(np.arange(width) * 6 // width) % 3][None].repeat(height, axis=0)
    for _ in range(14):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.circle(texture, centre, height // 14, (0.08, 0.08, 0.1), -1, cv2.LINE_AA)
    return texture.astype(np.float32)
