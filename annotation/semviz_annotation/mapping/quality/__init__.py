"""How good a map is: measured, looked over by rules, compared with another."""
