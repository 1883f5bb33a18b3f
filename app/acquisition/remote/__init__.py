"""The instrument in a process of its own: what travels, and both ends."""
