//! What is there: terrain, fires, smoke, lookalikes.
