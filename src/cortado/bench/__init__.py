"""What ``cortado bench`` measures: a dam break, pass by pass, beside what the hardware allows."""
