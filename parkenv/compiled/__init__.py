"""Compiled code: functions, memory, heaps and keyed streams of random numbers; nothing of parking."""
