"""The force sensor and the servo, real and simulated, behind two small protocols."""
