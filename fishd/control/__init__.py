"""One tick: estimate, let the controller choose, guard, drive the servo, report."""
