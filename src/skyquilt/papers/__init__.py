"""The methods of Yahyanejad 2013 and Arteaga et al. 2019, their benchmarks and report pages."""
