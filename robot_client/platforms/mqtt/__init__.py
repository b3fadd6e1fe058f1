"""MQTT devices as one robot: found by Home Assistant discovery and Homie (docs/guides/mqtt.md)."""
