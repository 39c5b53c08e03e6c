"""3-RRR: motors turn rigid cranks that carry the links, which hold a rigid platform."""
