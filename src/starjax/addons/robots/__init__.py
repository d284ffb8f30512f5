"""The dVRK's patient side manipulator, CRTK's messages, and mounts of arms."""
