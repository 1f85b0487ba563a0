"""This room holds what `train.fly` and `train.mission` do with several UAVs."""
