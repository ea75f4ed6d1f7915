"""Rays that start in common points and are fixed in moving frames."""

import dataclasses as dc

import numpy as np

# At most this many rays are checked together against a shape's box.
_GROUP_SIZE = 32


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RayBundles:
    """Rays that start in m points and are fixed in moving frames.

    Made by `RayCaster.make_bundles`, and good for that caster only.
    """

    num_bundles: int
    """m."""
    fan_S: np.ndarray
    """Unit directions of each bundle's rays in its frame S, shape (k, 3)."""
    X_FS: np.ndarray
    """Poses of the bundles in their frames, shape (m, 3, 4)."""
    frame_index: np.ndarray
    """Each bundle's frame as index into `RayCaster.frame_ids`, shape (m,)."""
    max_range: np.ndarray
    """Length of each bundle's rays, m, shape (m,)."""
    active: np.ndarray
    """Whether a bundle is cast against a geometry, shape (m, geometries)."""
    min_range: np.ndarray
    """Where each bundle's rays begin to see, m, shape (m,)."""
    starts_later: bool
    """Whether any of the bundles does not see from its origin on."""
    owner: object = dc.field(repr=False)
    """The caster that has made them."""
    packed: np.ndarray = dc.field(repr=False)
    """The bundles as the kernels take them, shape (m, 14)."""
    everyone: np.ndarray = dc.field(repr=False)
    """True for each bundle, bool, shape (m,)."""
    sorted_fan: np.ndarray = dc.field(repr=False)
    """Directions and places of the rays, sorted into groups, shape (4, k)."""
    cones: np.ndarray = dc.field(repr=False)
    """Around all rays, then around each group, shape (1 + groups, 7)."""


def pack_bundles(
    *,
    owner: object,
    fan_S: np.ndarray,
    X_FS: np.ndarray,
    frame_index: np.ndarray,
    max_range: np.ndarray,
    min_range: np.ndarray,
    active: np.ndarray,
) -> RayBundles:
    """Makes RayBundles, with read-only arrays; see their fields."""
    m = len(X_FS)
    order, cones = _group_directions(fan_S)
    bundles = RayBundles(
        num_bundles=m,
        fan_S=fan_S,
        X_FS=X_FS,
        frame_index=frame_index,
        max_range=max_range,
        active=active,
        min_range=min_range,
        starts_later=bool(min_range.any()),
        owner=owner,
        packed=np.column_stack([X_FS.reshape(m, 12), max_range, frame_index]),
        everyone=np.ones(m, dtype=bool),
        sorted_fan=np.ascontiguousarray(np.vstack([fan_S[order].T, order])),
        cones=cones,
    )
    for field in dc.fields(bundles):
        value = getattr(bundles, field.name)
        # Writable like a caller's array, so that no other kernel is compiled.
        if isinstance(value, np.ndarray) and field.name != "everyone":
            value.flags.writeable = False
    return bundles


def _group_directions(fan_S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorts directions into narrow groups.

    Returns:
        (order, cones): which direction comes where, shape (k,), and a cone
        around all, then one around each group: axis, cosine and sine of half
        the opening angle, where the group begins, and where the next one
        does; shape (1 + groups, 7).
    """
    order = np.arange(len(fan_S))
    cones = [[*_calc_cone(fan_S), 0, len(fan_S)]]
    pending = [(0, len(fan_S))]
    while pending:
        first, last = pending.pop()
        directions = fan_S[order[first:last]]
        if last - first <= _GROUP_SIZE:
            cones.append([*_calc_cone(directions), first, last])
            continue
        axis = np.argmax(np.ptp(directions, axis=0))
        places = np.argsort(directions[:, axis], kind="stable")
        order[first:last] = order[first:last][places]
        middle = (first + last) // 2
        pending += [(middle, last), (first, middle)]
    return order, np.array(cones, dtype=float)


def _calc_cone(directions: np.ndarray) -> list[float]:
    """Returns axis, cos and sin of half the angle of a cone around them."""
    axis = directions.mean(axis=0)
    length = np.linalg.norm(axis)
    if length < 1e-3:
        # All around: no cone is narrower than the full sphere.
        return [1.0, 0.0, 0.0, -1.0, 0.0]
    axis = axis / length
    # The sine from the cross product: near 0 the cosine has no digits left.
    sin = np.linalg.norm(np.cross(directions, axis), axis=1)
    angle = np.arctan2(sin, directions @ axis).max()
    return [*axis, np.cos(angle), np.sin(angle)]
