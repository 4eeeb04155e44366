"""What an effects.py has for contacts: source that is copied there, beside that of `patch_runtime`."""


def place_contact(model, data, name, at, state):
    """For a contact: its geoms, the one whose fields change last, the pair if it is listed, and how its body moves."""
    if at.kind != "contact":
        return
    geoms = [model.geom(one).id for one in name.split("/")]
    bodies = [model.geom_bodyid[g] for g in geoms]
    listed = [set(pair) == set(geoms) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)]
    at.body = next(b for b in bodies if model.body_weldid[b])
    joint = model.body_jntadr[at.body]
    place, speed = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
    at.geoms, at.pair = tuple(geoms), listed.index(True) if any(listed) else -1
    state.q, state.v = data.qpos[place : place + 3], data.qvel[speed : speed + 3]
