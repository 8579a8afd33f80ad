"""Speed against peers and limits: one file a question. ``make bench`` runs them all.

Every figure is a ratio of two times taken in the same process, alternately, since machines are shared and noisy.
"""
