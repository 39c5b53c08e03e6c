from .rows import Row as Row
from .run import Verification as Verification
from .run import verify as verify
