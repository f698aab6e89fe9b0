"""The loaded bed of a scene, without its grains: points, strain rates, stresses, force, power and floating gap."""
