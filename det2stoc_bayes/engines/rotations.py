"""Unit quaternions (w, x, y, z) as arrays."""

import numpy as np
from jaxtyping import Float


def relative_rotation(
    first: Float[np.ndarray, "... 4"], second: Float[np.ndarray, "... 4"]
) -> Float[np.ndarray, "... 3"]:
    """Rotation vector [rad] of the shorter way from `first` to `second`, in the frame of `first`."""
    w = (first * second).sum(-1, keepdims=True)
    a, b = first[..., 1:], second[..., 1:]
    v = first[..., :1] * b - second[..., :1] * a - _cross(a, b)
    v = np.where(w < 0, -v, v)
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(size, np.abs(w))
    return v * np.where(size > 1e-12, angle / np.maximum(size, 1e-12), 2.0)


def rotated(quaternion: Float[np.ndarray, "... 4"], vector: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 4"]:
    """Turned by a rotation vector in its own frame; inverse of `relative_rotation`."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    v = vector * (0.5 * np.sinc(angle / (2 * np.pi)))
    c = np.cos(angle / 2)
    w, u = quaternion[..., :1], quaternion[..., 1:]
    return np.concatenate([w * c - (u * v).sum(-1, keepdims=True), w * v + c * u + _cross(u, v)], -1)


def product(first: Float[np.ndarray, "... 4"], second: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 4"]:
    """The rotation `second`, then `first`."""
    a, b, u, v = first[..., :1], second[..., :1], first[..., 1:], second[..., 1:]
    return np.concatenate([a * b - (u * v).sum(-1, keepdims=True), a * v + b * u + _cross(u, v)], -1)


def _cross(a: Float[np.ndarray, "... 3"], b: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """As np.cross, which takes several times as long."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out
