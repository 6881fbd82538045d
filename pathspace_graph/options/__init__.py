"""Options of the commands as frozen dataclasses: a field is an option, a field of settings a dotted one."""
