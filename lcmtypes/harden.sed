# Applied to every generated header. Without it a 20-byte message with a huge count makes decode()
# read past its buffer or allocate gigabytes.
s/^#include <lcm\/lcm_coretypes.h>/&\n#include "bodyschema\/least_wire_size.h"/
# A count must be one that the rest of the buffer can hold.
s/^\( *\)\(this->[A-Za-z0-9_]*\(\[[A-Za-z0-9_]*\]\)*\)\.resize(\(this->[A-Za-z0-9_]*\));/\1if(\4 < 0 || \4 > (maxlen - pos) \/ bodyschema::least_wire_size(\2)) return -1;\n\1\2.resize(\4);/
# A string has at least its terminating zero.
s/^\( *\)if(\(__[A-Za-z0-9_]*\) > maxlen - pos) return -1;/\1if(\2 < 1 || \2 > maxlen - pos) return -1;/
