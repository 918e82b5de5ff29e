"""config/group.conf: the processes of a group."""

import re


def processes(file, rig):
    """Name → command of the group of a rig, without optional processes whose file the rig lacks or disables."""
    group = {}
    for line in file.read_text().splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        name, command = line.split(None, 1)
        if name.endswith("?"):
            name = name[:-1]
            if not is_enabled(rig / f"{name}.yaml"):
                continue
        group[name] = command
    return group


def is_enabled(file):
    """The file exists and does not say `enabled: false`."""
    return file.exists() and not re.search(r"^enabled:\s*false\s*(#.*)?$", file.read_text(), re.MULTILINE)


def speakers(rig, names):
    """Those of `names` that publish PROCESS_INFO: they have a file in the rig."""
    return [name for name in names if (rig / f"{name}.yaml").exists()]
