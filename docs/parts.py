"""Draws the page of tasks, arms and tools from the registries."""

import math

import settings

from starjax.sim import registries


def page() -> str:
    """Returns tables of everything with a name, as `starjax list` shows it."""
    lines = ["## Tasks", ""]
    rows, first = [], {}
    for name in registries.tasks.built_in:
        task = registries.tasks.get(name)
        state = ", ".join(f"`{field.name}` {field.size}" for field in task.fields)
        experts = ", ".join(f"`{expert}`" for expert in task.experts)
        same = first.setdefault(task.text.strict, name)
        tests = [task.text.strict, task.text.loose] if same == name else [f"as `{same}`"] * 2
        cells = [str(task.arms), *tests, f"{task.time_limit_s:g} s"]
        rows.append((f"`{name}`", *cells, state, experts))
    head = ["task", "arms", "strict success", "loose", "time", "state and size", "experts"]
    lines += [settings.table(head, rows), "", "## Arms", ""]
    rows, mounts = [], {}
    for name in registries.arms.built_in:
        arm = registries.arms.get(name)
        rows.append((f"`{name}`", str(len(arm.joints))))
        for tool in dict.fromkeys(tool for tool, _ in arm.mounts):
            places = ", ".join(f"`{place}`" for held, place in arm.mounts if held == tool)
            mounts.setdefault((f"`{tool}`", places), []).append(f"`{name}`")
    lines += [settings.table(["arm", "joints"], rows), "", "### Mounts", ""]
    rows = [(*mount, ", ".join(arms)) for mount, arms in mounts.items()]
    lines += [settings.table(["tool", "in the workspaces", "on the arms"], rows)]
    lines += ["", "## Tools", ""]
    rows = []
    for name in registries.tools.built_in:
        tool = registries.tools.get(name)
        opening = 2 * (tool.open - tool.closed)
        opening = f"{math.degrees(opening):.0f}°" if tool.wrist else f"{1e3 * opening:.1f} mm"
        opening = opening if tool.jaw else "no jaws"
        rows.append((f"`{name}`", opening, f"{2e3 * tool.shaft_radius:g} mm"))
    lines += [settings.table(["tool", "opening of the jaws", "shaft"], rows)]
    return "\n".join(lines) + "\n"
