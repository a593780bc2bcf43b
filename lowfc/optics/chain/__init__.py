"""Light from the pupil to the sensor's pixels: pupils, masks, propagation."""
