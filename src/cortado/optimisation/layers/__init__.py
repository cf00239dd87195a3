"""Cortado as a layer of other programs: functions of named arrays, with derivatives, and the bridges to programs."""
