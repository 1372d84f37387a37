"""Cases are run here: from one episode to campaigns, truths and estimates."""
