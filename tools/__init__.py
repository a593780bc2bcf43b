"""Tables, pictures and layouts of the documentation (`python -m tools.measure`); benches of the simulated loop."""
