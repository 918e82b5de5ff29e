"""config/group.conf: which processes a group has."""


def processes(file, rig):
    """Name → command of the group of a rig: without what the rig has no file for."""
    group = {}
    for line in file.read_text().splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        name, command = line.split(None, 1)
        if name.endswith("?"):
            name = name[:-1]
            if not (rig / f"{name}.yaml").exists():
                continue
        group[name] = command
    return group


def speakers(rig, names):
    """Those of `names` that say how they are: what has a file in the rig."""
    return [name for name in names if (rig / f"{name}.yaml").exists()]
