"""What a network does to messages that are on their way, in netem's vocabulary; one file each.

A profile applies them in this order: schedule, loss, duplicate, slot, rate, delay (with reorder).
"""
