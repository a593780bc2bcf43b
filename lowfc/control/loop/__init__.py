"""The controller as one pure function: state, inputs, requests, safety."""
