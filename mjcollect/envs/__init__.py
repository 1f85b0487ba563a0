"""What an agent sees and is paid: courses, episodes, the dm-control and the batched environment.

Importing the package imports nothing: builders of guidance must not load torch.
"""
