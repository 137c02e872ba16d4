"""What a design problem is made of: lines, information, budgets, criteria, and the design with its certificate."""
