"""Model of a planar 3-PRR parallel robot with three flexible links: pure functions on pytrees.

Data flow: `Machine` and `Case` (physical numbers) -> `prepare` (matrices, coefficients) ->
`command` (shaped reference, noise) -> `step` per sample (controller, plant, metrics, status) ->
`RunResult`. Importing this package has no effect; set precision and devices before the first call.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
