"""The instrument in a process of its own: where it is found, what travels, and both ends."""
