"""What an effects.py has for contacts: source that is copied there, beside that of `patch_runtime`."""


def place_contact(model, data, name, at, state):
    """For a contact: its geoms, the one that moves first, the pair if it is listed, and where the moving body is."""
    if at.kind != "contact":
        return
    geoms = [model.geom(one).id for one in name.split("/")]
    geoms.sort(key=lambda g: -bool(model.body_weldid[model.geom_bodyid[g]]))
    listed = [set(pair) == set(geoms) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)]
    first = model.jnt_qposadr[model.body_jntadr[model.geom_bodyid[geoms[0]]]]
    at.geoms, at.pair = tuple(geoms), listed.index(True) if any(listed) else -1
    state.q = data.qpos[first : first + 3]
