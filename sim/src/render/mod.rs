//! What a camera sees of it.
