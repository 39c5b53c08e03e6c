"""Five-bar: two motors turn rigid cranks that carry the links, which meet in a point."""
