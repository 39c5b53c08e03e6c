"""3-PRR: sliders on straight guides carry the links, which hold a rigid platform."""
