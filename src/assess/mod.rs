//! How a fire changes: size in metres, intensity, trend. Pure: no I/O, no clock.
