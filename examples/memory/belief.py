"""The belief as memory: a network without one that observes P(taken) of each slot.

`--observation` makes it the reactive network of the other twins: `no-map`, `step`.
"""

from ppo import Reactive, main

if __name__ == "__main__":
    main("reactive", Reactive, "belief")
