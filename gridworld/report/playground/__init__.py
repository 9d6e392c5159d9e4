"""The playground: a page in the browser that solves a world, lets tables learn in it, looks into a run."""
