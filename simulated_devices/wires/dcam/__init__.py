"""A C9100-23B behind the DCAM-API: a C library that takes the place of Hamamatsu's, and the hand that moves it."""
