"""config/group.conf: the processes of a group."""


def processes(file, rig):
    """Name → command of the group of a rig, without processes for which the rig has no file."""
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
    """Those of `names` that publish PROCESS_INFO: they have a file in the rig."""
    return [name for name in names if (rig / f"{name}.yaml").exists()]
