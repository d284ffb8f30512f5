"""One process of several that loads a scene, which must lie on a device of its own."""

if __name__ == "__main__":
    from starjax import runtime

    runtime.prepare_xla()
    from starjax.runtime import processes

    processes.join()
    import jax

    from starjax.sim import scene

    found = scene.load(scene.name("reach"))
    leaves = jax.tree.leaves((found.mjx_model, found.mjx_data))
    places = [leaf.devices() for leaf in leaves if isinstance(leaf, jax.Array)]
    assert places and set.union(*places) <= set(jax.local_devices()), places
