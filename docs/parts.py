"""Draws the page of tasks, arms and tools from the registries."""

import settings

from starjax.sim import registries


def page() -> str:
    """Returns tables of everything with a name, as `starjax list` shows it."""
    lines = ["## Tasks", ""]
    rows = []
    for name in registries.tasks.built_in:
        task = registries.tasks.get(name)
        state = ", ".join(f"`{field.name}` {field.size}" for field in task.fields)
        experts = ", ".join(f"`{expert}`" for expert in task.experts)
        cells = [str(task.arms), task.text.strict, task.text.loose, f"{task.time_limit_s:g} s"]
        rows.append((f"`{name}`", *cells, state, experts))
    head = ["task", "arms", "strict success", "loose", "time", "state and size", "experts"]
    lines += [settings.table(head, rows), "", "## Arms", ""]
    rows = []
    for name in registries.arms.built_in:
        arm = registries.arms.get(name)
        mounts = ", ".join(f"`{tool}` in `{place}`" for tool, place in arm.mounts)
        rows.append((f"`{name}`", str(len(arm.joints)), mounts))
    lines += [settings.table(["arm", "joints", "mounts: tool in workspace"], rows)]
    lines += ["", "## Tools", ""]
    rows = []
    for name in registries.tools.built_in:
        tool = registries.tools.get(name)
        opening = f"{2e3 * (tool.open - tool.closed):.1f} mm" if tool.jaw else "no jaws"
        rows.append((f"`{name}`", opening, f"{2e3 * tool.shaft_radius:g} mm"))
    lines += [settings.table(["tool", "opening of the jaws", "shaft"], rows)]
    return "\n".join(lines) + "\n"
