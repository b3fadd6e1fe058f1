"""Who may command motion: service, controller, lease, stop, rearm, suppression (SPEC section 1.7)."""
