"""Light from the pupil to the sensor's pixels and the science image: pupils, masks, propagation."""
