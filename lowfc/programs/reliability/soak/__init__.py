"""`lowfc soak`: does anything grow, drift or get lost in hours?"""
