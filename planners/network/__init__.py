"""`network`: one small neural network for every lot, which scores the actions at hand by what lies behind them."""
