"""`lowfc doctor`: is this host fit for a real-time loop?"""
