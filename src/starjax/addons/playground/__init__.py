"""Tasks as environments of MuJoCo Playground."""
