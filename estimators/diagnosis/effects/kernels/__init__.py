"""Compiled recursions of the effects: those inside a plant, and those of an actuator or a sensor."""
